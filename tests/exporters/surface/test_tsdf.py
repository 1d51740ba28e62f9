"""Tests of the fused depth of a ball: its radius, the faces' winding, and the pixels that are left out."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from exporters.surface.depth_views import DepthView
from exporters.surface.tsdf import fuse_depth, reliable_depth
from player.errors import DataError, MissingExtraError
from tests.exporters.surface.test_depth_views import BLACK, all_around, camera, sphere_view


@pytest.mark.needs("open3d")
def test_a_ball_again() -> None:
    vertices, faces, normals = fuse_depth(all_around(1.0), 0.06)
    radius = np.linalg.norm(vertices, axis=-1)
    # Depth is taken from the nearest pixel, and a pixel here is as wide as a voxel.
    assert np.abs(radius - 1).mean() < 0.25 * 0.06 and np.abs(radius - 1).max() < 2 * 0.06
    cosines = (normals * vertices).sum(-1) / radius
    assert cosines.mean() > 0.97 and (cosines > 0).mean() > 0.999
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    # six views leave gaps, so that there is no closed volume: check that the faces look outwards
    across = np.cross(b - a, c - a)
    outwards = (across * (a + b + c)).sum(-1) > 0
    assert np.linalg.norm(across[outwards], axis=-1).sum() > 0.99 * np.linalg.norm(across, axis=-1).sum()
    again = fuse_depth(all_around(1.0), 0.06)
    assert all(x.tobytes() == y.tobytes() for x, y in zip(again, (vertices, faces, normals), strict=True))


@pytest.mark.needs("open3d")
def test_a_ball_far_from_the_origin() -> None:
    """In the coordinates of a map the surface is the same as near the origin, but for what float64 rounds:
    one voxel is 0.06, and float32 would have steps of 0.5."""
    shift = np.array([4.5e6, -5e5, 300.0])
    moved = []
    for view in all_around(1.0):
        c2w = view.camera.c2w.copy()
        c2w[:3, 3] += shift
        moved.append(replace(view, camera=replace(view.camera, c2w=c2w)))
    near, far = fuse_depth(all_around(1.0), 0.06), fuse_depth(moved, 0.06)
    assert abs(len(far.faces) - len(near.faces)) < 0.01 * len(near.faces)
    radius = np.linalg.norm(far.vertices - shift, axis=-1)
    assert np.abs(radius - 1).mean() < 0.25 * 0.06 and np.abs(radius - 1).max() < 2 * 0.06


def test_depth_along_the_axis_and_jumps() -> None:
    view = sphere_view((0.0, 0.001, 5.0), 1.0)
    depth = reliable_depth(view, 0.3)
    rows, columns = np.nonzero(depth)
    x, y = (columns + 0.5 - 32) / 96, (rows + 0.5 - 32) / 96
    np.testing.assert_allclose(
        depth[rows, columns] * np.sqrt(1 + x * x + y * y), view.distance[rows, columns], rtol=1e-5
    )
    assert (depth > 0).sum() > 0.8 * np.isfinite(view.distance).sum()
    step = np.full((8, 8), 2.0, np.float32)
    step[:, 4:] = 3.0
    step[0, 0] = np.inf
    seen_by = camera((0.0, 0.001, 5.0), 8)
    near = reliable_depth(DepthView(seen_by, step, BLACK), 0.3)
    assert not near[:, 3:5].any() and (near[1:, :3] > 0).all() and (near[:, 5:] > 0).all() and near[0, 0] == 0
    assert (near[0, 1:3] > 0).all()  # a pixel beside nothing is at no jump


@pytest.mark.needs("open3d")
def test_nothing_in_view(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = DepthView(camera((0.0, 0.001, 5.0)), np.full((64, 64), np.inf, np.float32), BLACK)
    with pytest.raises(DataError, match="expected a surface in the training cameras' views, got none"):
        fuse_depth([nothing], 0.06)
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r"needs open3d: pip install 'vfr-bake\[export\]'"):
        fuse_depth([nothing], 0.06)
