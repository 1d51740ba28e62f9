"""Tests of pyramids turned into one level for exporters: equal values in every cell, and a ball's surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from exporters.shapes.volume import asset_volume
from exporters.surface.inner_region import inner_region
from exporters.surface.marching_cubes import cut_surface, settled
from exporters.surface.one_level import one_level
from player.asset.asset import Asset, GridArrays
from player.asset.bricks import unpack_vertices
from player.asset.pyramid import Pyramid, PyramidValues
from player.errors import ConfigError, ShapeError
from tests.player.march.pyramid_scene import Reading, filled, random_pyramid, random_scene
from tests.player.march.test_levels import linear, shapes

PLENTY = 1 << 40


def far(pyramid: Pyramid) -> list[np.ndarray]:
    """Return each level's codes: 128 at a quarter of the box from its middle, and 4 less per finest cell
    outwards."""
    quarter = pyramid.resolution / 4
    middle = pyramid.resolution / 2
    return [
        128 - 4 * (np.linalg.norm(v.index * 2**level - middle, axis=1, keepdims=True) - quarter)
        for level, v in enumerate(pyramid.vertices)
    ]


@pytest.mark.parametrize("resolution", [24, 27])
@pytest.mark.parametrize("n_levels", [1, 2, 3])
def test_one_level_shows_what_the_levels_show(resolution: int, n_levels: int) -> None:
    scene = random_scene(resolution, 30, (1,) * n_levels, seed=n_levels)
    flat = one_level(scene.densities, PLENTY, "asset")
    (cells,) = flat.pyramid.levels
    shown = set(map(tuple, unpack_vertices(cells.coords, cells.masks).tolist()))
    reading = scene.code
    every = map(tuple, np.argwhere(np.ones((resolution,) * 3)).tolist())
    assert shown == {cell for cell in every if reading.live_at(np.array(cell) + 0.5)}
    one, worst = Reading(flat), 0.0
    for cell in sorted(shown)[::7]:
        g = np.array(cell) + 0.25
        level = reading.level(g)
        assert level is not None
        apart = abs(float(one.at(g, 0)[0][0] - reading.at(g, level)[0][0]))
        assert apart <= (0.5 * level) + 1e-9, "a code is rounded once a level"
        worst = max(worst, apart)
    assert worst > 0 or n_levels == 1


def test_a_ramp_stays_a_ramp() -> None:
    pyramid = shapes(32)["three"]
    flat = one_level(filled(pyramid, linear(pyramid, (1, 1, 1), 60), (0, 255), np.uint8), PLENTY, "asset")
    index = flat.pyramid.vertices[0].index
    assert len(index) == 33**3 and (flat.values[0][:, 0] == index.sum(axis=1) + 60).all()


def test_more_than_fits() -> None:
    scene = random_scene(44, 30, (1, 1, 1), seed=3)
    with pytest.raises(ConfigError, match=r"asset: memory: expected at most .*--max-memory"):
        one_level(scene.densities, 1 << 20, "asset")


@pytest.mark.parametrize("contracted", [False, True])
def test_the_surface_of_a_ball_is_closed_and_round(opened: Asset, contracted: bool) -> None:
    """The surface is closed and round where levels meet inside the ball and across its surface."""
    pyramid = shapes(40)["three"]
    stored = filled(pyramid, far(pyramid), (0, 255), np.uint8)
    none = PyramidValues(random_pyramid(20, 2, 0), ())
    features = filled(none.pyramid, [np.zeros((v.n, 4)) for v in none.pyramid.vertices], (-127, 127), np.int8)
    half = 2.0 if contracted else 1.0
    box = ((-half,) * 3, (half,) * 3)
    manifest = replace(
        opened.manifest,
        resolution=40,
        feature_resolution=20,
        aabb=box,
        step=0.05,
        contracted=contracted,
        level_steps=(1, 1, 1),
        density_steps=(1, 1, 1),
        feature_steps=(1,) * len(none.pyramid.levels),
        parts=(),
    )
    whole = Asset(opened.folder, manifest, GridArrays(stored, features))
    with pytest.raises(ShapeError, match="expected a grid of one level, got 3 levels"):
        cut_surface(whole.grid)
    asset = inner_region(whole)
    low, high = manifest.density_range
    level = float(np.exp(low + (high - low) * (160 if contracted else 128) / 255))
    surface = settled(asset.grid, cut_surface(asset.grid, level))
    radius = np.linalg.norm(surface.vertices, axis=1)
    expected = (10 - (8 if contracted else 0)) * half / 20
    assert np.abs(radius - expected).max() < 0.3 * half / 20, "a third of a cell: codes are interpolated"
    edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all(), "every edge has two faces: there is no gap where levels meet"
    volume, _ = asset_volume(asset, np.eye(4))
    assert len(volume.index) == len(asset.arrays.densities.values[0])
