"""Tests of meshes with as many faces or bytes as are wanted, of solids in closed form."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from exporters.formats.ply import small_ply_bytes
from exporters.surface.asset_surface import AssetSurface
from exporters.surface.few_faces import few_faces
from player.asset.asset import Asset
from player.errors import DataError
from player.progress import silent
from tests.exporters.conftest import BALL_CENTRE, BALL_RADIUS
from tests.exporters.solids import WORLD_FROM_MODEL, Distance, write_solid


def radii(vertices: np.ndarray) -> np.ndarray:
    """Return the distances of vertices from the middle of the tests' ball, divided by its radius."""
    centre = np.array(WORLD_FROM_MODEL)[:3] @ [*BALL_CENTRE, 1]
    return np.linalg.norm(vertices - centre, axis=-1) / (2 * BALL_RADIUS)


@pytest.mark.needs("open3d")
@pytest.mark.parametrize("max_bytes", [None, 60_000, 10_000, 2_000])
def test_a_ball_within_its_bytes(max_bytes: int | None, ball_asset: Asset) -> None:
    whole, _ = AssetSurface(ball_asset, silent).from_density()
    mesh, removed = few_faces(AssetSurface(ball_asset, silent), 36, max_bytes)
    assert len(mesh.faces) == pytest.approx(len(whole.faces) / 4, rel=0.1) or max_bytes is not None
    if max_bytes is not None:
        assert max_bytes / 2 < len(small_ply_bytes(mesh)) <= max_bytes
    # the fewest faces make a polyhedron with corners on the ball, whose level is up to a voxel outside
    assert np.abs(radii(mesh.vertices) - 1).max() < 0.1
    assert removed.haze_faces == 0 and (mesh.colours == 255).all()


def test_without_open3d_the_stride_alone_decides(ball_asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    mesh, _ = few_faces(AssetSurface(ball_asset, silent), 72, 30_000)
    assert 3_000 < len(small_ply_bytes(mesh)) <= 30_000
    # unstored cells count as empty, which makes a wall inside; some of it is seen through the corners
    assert np.median(np.abs(radii(mesh.vertices) - 1)) < 0.1


@pytest.mark.needs("open3d")
def test_a_surface_of_many_small_parts_fits_too(tmp_path: Path) -> None:
    """A surface of many small closed parts fits too, though each needs at least a few faces."""
    centres = np.stack(np.meshgrid(*3 * [np.linspace(-0.7, 0.7, 7)], indexing="ij"), axis=-1).reshape(-1, 3)

    def specks() -> Distance:
        return lambda points: (
            np.min([np.linalg.norm(points - centre, axis=-1) for centre in centres], axis=0) - 0.07
        )

    asset = write_solid(tmp_path / "asset", specks(), 64)
    mesh, _ = few_faces(AssetSurface(asset, silent), 64, 8_000)
    assert 0 < len(small_ply_bytes(mesh)) <= 8_000
    with pytest.raises(DataError, match="expected"):
        few_faces(AssetSurface(asset, silent), 64, 1)
