"""Tests of marching cubes on the sparse grid of solids in closed form."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from exporters.shapes.mesh import Surface
from exporters.surface import marching_cubes as asset_surface
from exporters.surface.marching_cubes import (
    code_and_slope,
    cut_surface,
    half_opaque,
    onto_level,
    settled,
    voxel_size,
)
from player.asset.asset import Asset
from player.asset.grid import SparseGrid
from player.errors import ConfigError, MissingExtraError
from player.march.normals import code_gradient
from tests.exporters.conftest import BALL_CENTRE, BALL_RADIUS, CUBE_HIGH, CUBE_LOW
from tests.exporters.solids import ball, offset_of, write_solid


def surface_of(grid: SparseGrid, level: float | None = None, stride: int = 1) -> Surface:
    return settled(grid, cut_surface(grid, level, stride=stride))


@pytest.mark.parametrize("factor", [None, 2.0, 5.0])
def test_a_ball_has_its_radius_its_normals_and_no_hole(ball_asset: Asset, factor: float | None) -> None:
    grid, voxel = ball_asset.grid, 2 / 72
    level = half_opaque(grid) * (factor or 1)
    vertices, faces, normals = surface_of(grid, None if factor is None else level)
    outward = vertices - BALL_CENTRE
    distance = np.linalg.norm(outward, axis=-1)
    # A step of a code is 0.02 of a voxel; between vertices the distance bends by voxel^2 / (8 radius).
    assert np.abs(distance - BALL_RADIUS - offset_of(level, 72)).max() < 0.04 * voxel
    assert len(vertices) - len(faces) / 2 == 2  # Euler: closed, one part, also where blocks meet
    cosines = (normals * outward).sum(-1) / distance
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < 3
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * math.pi * (BALL_RADIUS + offset_of(level, 72)) ** 3, rel=5e-3)


def test_every_second_vertex_gives_the_same_ball_in_a_quarter_of_the_faces(ball_asset: Asset) -> None:
    """A stride of 2 gives the same ball in a quarter of the faces, and a wall inside it, where stored cells
    end, which no camera sees."""
    grid = ball_asset.grid
    vertices, faces, normals = surface_of(grid, stride=2)
    outward = vertices - BALL_CENTRE
    distance = np.linalg.norm(outward, axis=-1)
    outside = distance > BALL_RADIUS
    offset = offset_of(half_opaque(grid), 72)
    assert np.abs(distance[outside] - BALL_RADIUS - offset).max() < 0.06 * 2 / 72, "on the fine grid's level"
    shell = faces[outside[faces].all(axis=1)]
    assert outside[faces].any(axis=1).sum() == len(shell), "and the two do not meet"
    assert outside.sum() - len(shell) / 2 == 2
    assert len(shell) == pytest.approx(len(surface_of(grid)[1]) / 4, rel=0.1)
    assert (normals * outward)[outside].sum(-1).min() > 0


def test_blocks_do_not_show(ball_asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    one = surface_of(ball_asset.grid)
    for size in (16, 128):
        monkeypatch.setattr(asset_surface, "BLOCK", size)
        other = surface_of(ball_asset.grid)
        assert len(other[0]) == len(one[0]) and len(other[1]) == len(one[1])
        apart, nearest = KDTree(one[0]).query(other[0])
        assert apart.max() < 1e-6 and len(np.unique(nearest)) == len(one[0])


def test_a_box_keeps_its_place_and_size(cube_asset: Asset) -> None:
    vertices, faces, _ = surface_of(cube_asset.grid)
    offset = offset_of(half_opaque(cube_asset.grid), 48)
    np.testing.assert_allclose(vertices.min(0), np.array(CUBE_LOW) - offset, rtol=0, atol=0.1 * 2 / 48)
    np.testing.assert_allclose(vertices.max(0), np.array(CUBE_HIGH) + offset, rtol=0, atol=0.1 * 2 / 48)
    assert len(vertices) - len(faces) / 2 == 2


@pytest.mark.parametrize("by_faces", [False, True])
def test_normals_are_right_in_a_box_that_is_no_cube(
    ball_asset: Asset, by_faces: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Normals are right where a box that is no cube makes the ball an ellipsoid, twice as long along y."""
    grid, stretch = ball_asset.grid, np.array([1.0, 2.0, 1.0])
    low, per_unit = (-stretch).astype(np.float32), (36 / stretch).astype(np.float32)
    long = replace(grid, aabb_min=low, cells_per_unit=per_unit)
    cut = cut_surface(long)
    if by_faces:
        monkeypatch.setattr(asset_surface, "_CLIP", 0.0)  # clips slopes to 0: normals come from faces
    vertices, _, normals = settled(long, cut)
    outward = vertices / stretch - BALL_CENTRE
    assert np.linalg.norm(outward, axis=-1).mean() == pytest.approx(BALL_RADIUS, abs=0.05)
    along = outward / stretch
    cosines = (normals * along).sum(-1) / np.linalg.norm(along, axis=-1)
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < 6, "twice that of a ball; unstretched 19"


def test_code_and_slope_are_those_of_the_player(ball_asset: Asset) -> None:
    grid = ball_asset.grid
    directions = np.random.default_rng(0).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    g = (BALL_CENTRE + directions * BALL_RADIUS + 1) * 36
    codes, slopes, known = code_and_slope(grid, g)
    assert known.all()
    np.testing.assert_allclose(slopes, code_gradient(grid, g.T.astype(np.float32)).T, rtol=0, atol=1e-2)
    log_sigmas = grid.density_low + grid.density_slope * codes
    np.testing.assert_allclose(log_sigmas, 4.0, rtol=0, atol=0.05)
    far = np.array([[36.0, 36, 36], [-1, 5, 5], [73, 5, 5], [0, 0, 0]])
    assert not code_and_slope(grid, far)[2].any() and not code_and_slope(grid, far)[0].any()


def test_points_move_onto_the_level(ball_asset: Asset) -> None:
    grid = ball_asset.grid
    directions = np.random.default_rng(1).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    code = (4.0 - float(grid.density_low)) / float(grid.density_slope)  # the code at distance 0
    beside = BALL_RADIUS + np.linspace(-0.45, 0.45, 300)[:, None] * 2 / 72
    moved = onto_level(grid, (BALL_CENTRE + directions * beside + 1) * 36, code)
    assert np.abs(code_and_slope(grid, moved)[0] - code).max() < 0.5
    radius = np.linalg.norm(moved / 36 - 1 - BALL_CENTRE, axis=-1)
    assert np.abs(radius - BALL_RADIUS).max() < 0.04 * 2 / 72
    inside = np.array([[36.0, 36, 36]])  # not stored: nothing is known there
    assert np.array_equal(onto_level(grid, inside, code), inside)


def test_a_thin_fog_still_has_a_surface(tmp_path: Path) -> None:
    """A fog that is nowhere half opaque over a voxel has a surface at the middle of its densities."""
    asset = write_solid(tmp_path / "fog", ball((0, 0, 0), 0.5), 12)
    grid = asset.grid
    thin = type(grid)(**{**vars(grid), "density_low": np.float32(grid.density_low - 6)})
    vertices, _, _ = surface_of(thin)
    assert len(vertices) > 50


def test_refusals(ball_asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    for level in (0.0, -3.0, 1e-9, 1e9, math.nan, math.inf):
        with pytest.raises(ConfigError, match=r"--level: expected a density between .* and .*, the range of"):
            surface_of(ball_asset.grid, level)
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(MissingExtraError, match=r"scikit-image: pip install 'vfr-bake\[export\]'"):
        surface_of(ball_asset.grid)


def test_voxel_size(ball_asset: Asset) -> None:
    assert voxel_size(ball_asset.grid) == pytest.approx(2 / 72)
