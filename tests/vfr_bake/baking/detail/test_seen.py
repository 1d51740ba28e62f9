"""Cells that hardly anything sees: the weights that decide which they are, and what is left without them."""

from __future__ import annotations

import numpy as np
import pytest

from player.asset.bricks import stored_bits
from player.cameras.camera import Camera
from player.march.march import sample_rays
from player.progress import silent
from vfr_bake.baking.cells import Resolutions
from vfr_bake.baking.detail.seen import block_weights, heavy_blocks, thinned
from vfr_bake.baking.detail.shown import take_rows
from vfr_bake.baking.grids import Layout, make_layout
from vfr_bake.data.demo import demo_cameras
from vfr_bake.kernels.latent_rows import PARTS


def views(n: int) -> list[Camera]:
    """Return cameras around the box."""
    return demo_cameras(24, n)


def layout_of(visible: np.ndarray, densities: int, features: int, contracted: bool = False) -> Layout:
    return make_layout(visible, 0.02, Resolutions(densities, features), contracted)


@pytest.mark.parametrize("contracted", [False, True])
def test_block_weights_are_those_of_the_march_summed(contracted: bool) -> None:
    random = np.random.default_rng(0)
    layout = layout_of(random.random((10, 10, 10)) < 0.4, 40, 40, contracted)
    codes = random.uniform(0, 200, len(layout.densities)).astype(np.float32)
    grid = layout.grid(codes, np.zeros((len(layout.features), 1), np.int16))
    cameras = views(3)
    found = block_weights(grid, cameras, 10**9, silent)
    expected = np.zeros(found.shape)
    for camera in cameras:
        path, samples, *_ = sample_rays(grid, *camera.rays())
        at = grid.find(path.at(samples.ray, samples.s))
        for entry, cell, weight in zip(
            at.entries, at.cells.T, samples.weights.astype(np.float64), strict=True
        ):
            x, y, z = (int(c) % 8 // 2 for c in cell)
            expected[int(entry) >> 3, x, y, z] += weight
    assert expected.sum() > 100
    # Rounding may put a sample on the border of two blocks into the other one.
    assert np.abs(found - expected).sum() < 1e-3 * expected.sum()
    fewer = block_weights(grid, cameras, 100, silent)
    assert 0.5 < fewer.sum() / 100 / (expected.sum() / (3 * 24 * 24)) < 2


def test_what_weighs_least_is_left_out_first() -> None:
    random = np.random.default_rng(1)
    weights = random.exponential(size=(5, 4, 4, 4)) * (random.random((5, 4, 4, 4)) < 0.7)
    for share in (0.0, 1e-3, 0.1, 0.5):
        kept = heavy_blocks(weights, share)
        assert not kept[weights == 0].any()
        assert weights[~kept].sum() <= share * weights.sum() < weights[~kept].sum() + weights[kept].min()
        assert weights[~kept].max() <= weights[kept].min()
    assert not heavy_blocks(np.zeros((1, 4, 4, 4)), 0.0).any()


def test_fog_that_nobody_saw_is_left_out() -> None:
    """Fog within a shell that no ray passes is left out, and the pictures stay the same."""
    middle = (np.indices((16, 16, 16)) + 0.5) / 16 - 0.5
    radius = np.linalg.norm(middle, axis=0)
    layout = layout_of(radius < 0.4, 64, 48)
    away = np.linalg.norm(layout.densities.index / 64 - 0.5, axis=1)
    density = np.where(away > 0.3, 255, 120).astype(np.float32)
    features = (
        np.random.default_rng(2).integers(-9 * PARTS, 9 * PARTS, (len(layout.features), 2)).astype(np.int16)
    )
    grid = layout.grid(density, features)
    weights = block_weights(grid, views(12), 10**6, silent)
    left = thinned(layout, heavy_blocks(weights, 0.0))
    kept = np.linalg.norm(left.layout.densities.index / 64 - 0.5, axis=1)
    assert len(kept) < 0.8 * len(away)
    assert kept.min() > 0.3 and away.min() == 0
    seen = left.layout.grid(density[left.densities], features[left.features])
    for camera in views(12):
        before, after = (sample_rays(g, *camera.rays())[3] for g in (grid, seen))
        assert np.allclose(np.exp(-before), np.exp(-after), atol=2e-3)


@pytest.mark.parametrize("features", [40, 28, 15])
def test_rows_stay_with_their_vertices_and_features_wherever_densities_are(features: int) -> None:
    random = np.random.default_rng(features)
    layout = layout_of(random.random((10, 10, 10)) < 0.5, 40, features)
    (bricks,) = layout.densities.pyramid.levels
    blocks = random.random((len(bricks), 4, 4, 4)) < 0.3
    left = thinned(layout, blocks)
    for before, after, rows in (
        (layout.densities, left.layout.densities, left.densities),
        (layout.features, left.layout.features, left.features),
    ):
        assert np.array_equal(before.index[rows], after.index) and (np.diff(rows) > 0).all()
    cells = {tuple(c) for c in live(layout.densities.pyramid.levels[0])}
    expected = {c for c in cells if blocks[bricks.find(np.array([c]) >> 3)[0]][tuple(np.array(c) % 8 // 2)]}
    assert {tuple(c) for c in live(left.layout.densities.pyramid.levels[0])} == expected
    there = {tuple(c) for c in live(layout.features.pyramid.levels[0])}
    kept = {tuple(c) for c in live(left.layout.features.pyramid.levels[0])}
    assert kept < there
    places = [(np.array(c) + random.random((9, 3))) * features / 40 for c in expected]
    wanted = {tuple(p) for p in np.concatenate(places).astype(int).tolist()}
    assert wanted & there <= kept


def live(bricks) -> list[list[int]]:
    brick, bit = np.nonzero(stored_bits(bricks.masks))
    local = np.stack([bit >> 6, (bit >> 3) & 7, bit & 7], axis=-1)
    return (bricks.coords.astype(int)[brick] * 8 + local).tolist()


def test_rows_are_taken_in_place() -> None:
    values = np.arange(2_000_000, dtype=np.int32).reshape(-1, 2)
    rows = np.flatnonzero(np.random.default_rng(0).random(len(values)) < 0.7)
    expected = values[rows].copy()
    taken = take_rows(values, rows)
    assert np.array_equal(taken, expected) and np.shares_memory(taken, values)
