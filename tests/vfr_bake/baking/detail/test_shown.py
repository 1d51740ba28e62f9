"""Coarser levels in place of bricks that they can stand for: the error of each brick, and what is stored."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest

from player.asset.grid import build_grid
from player.asset.pyramid import PyramidValues, predicted
from player.asset.sections import Grid
from player.march.march import march, sample_rays
from tests.vfr_bake.baking.detail.test_seen import layout_of, views
from vfr_bake.baking.coarser_levels import pyramid_beneath
from vfr_bake.baking.detail.errors import (
    density_errors,
    feature_errors,
    heavy_vertices,
    levels_of_densities,
    levels_of_features,
)
from vfr_bake.baking.detail.search import largest
from vfr_bake.baking.detail.shown import Choice, Wanted, mean_values, wanted_values
from vfr_bake.baking.distillation import TeacherRays
from vfr_bake.baking.grids import Layout, latent
from vfr_bake.baking.rate.choices import Choices
from vfr_bake.training.length.witness_loss import Loss


def rays_of(n_views: int) -> TeacherRays:
    pairs = [camera.rays() for camera in views(n_views)]
    rays_o, rays_d = (np.concatenate(column) for column in zip(*pairs, strict=True))
    n = len(rays_o)
    return TeacherRays(rays_o, rays_d, np.zeros((n, 3)), np.ones(n, np.float32))


def some_layout(seed: int, features: int = 40, contracted: bool = False) -> Layout:
    visible = np.random.default_rng(seed).random((10, 10, 10)) < 0.5
    return layout_of(visible, 40, features, contracted)


def faint(layout: Layout, seed: int) -> np.ndarray:
    """Return density codes so low that no ray becomes opaque."""
    return np.random.default_rng(seed).uniform(60, 160, len(layout.densities)).astype(np.uint8)[:, None]


@pytest.mark.parametrize(("features", "contracted"), [(40, False), (34, False), (40, True)])
def test_the_error_of_a_feature_brick_is_what_the_march_shows_differently(
    features: int, contracted: bool
) -> None:
    layout, random = some_layout(3, features, contracted), np.random.default_rng(4)
    codes = random.integers(-90, 90, (len(layout.features), 3)).astype(np.int8)
    grid = layout.grid(faint(layout, 5)[:, 0], latent(codes))
    pyramid, rays = pyramid_beneath(layout.features.pyramid), rays_of(2)
    values = [np.rint(v).astype(np.int8) for v in mean_values(pyramid, codes, np.ones(len(codes)))]
    levels = levels_of_features(grid, pyramid, np.concatenate(values[:3]), 3)
    errors = feature_errors(levels, rays)
    assert errors.shape == (3, len(pyramid.levels[0])) and not errors[0].any()

    def shown(brick: int, level: int) -> np.ndarray:
        chosen = np.zeros(errors.shape[1], int)
        chosen[brick] = level
        found = march(levels.at(chosen), rays.rays_o, rays.rays_d, 0)
        out = np.zeros((len(rays.rays_o), 3))
        out[found.hits] = found.features
        return out

    finest = shown(0, 0)
    for brick in random.choice(errors.shape[1], 6, replace=False):
        for level in (1, 2):
            expected = ((shown(brick, level) - finest) ** 2).sum()
            assert errors[level, brick] == pytest.approx(expected, rel=2e-3, abs=1e-3)
    assert (errors[1] > 0).sum() > 5


@pytest.mark.parametrize("contracted", [False, True])
def test_the_error_of_a_density_brick_is_that_of_its_segments(contracted: bool) -> None:
    layout, rays = some_layout(6, 40, contracted), rays_of(2)
    codes = faint(layout, 7)
    grid = layout.grid(codes[:, 0], np.zeros((len(layout.features), 1), np.int16))
    pyramid = pyramid_beneath(layout.densities.pyramid)
    values = [np.rint(v).astype(np.uint8) for v in mean_values(pyramid, codes, np.ones(len(codes)))]
    levels = levels_of_densities(grid, pyramid, values[:3])
    found = density_errors(levels, rays)

    def segments(level: int) -> tuple[dict, dict]:
        """Return each ray's optical depth in each brick, and the light that reaches the brick, by samples."""
        of_level = levels.at(level)
        path, samples, *_ = sample_rays(of_level, rays.rays_o, rays.rays_d)
        bricks = (of_level.cells(path.at(samples.ray, samples.s)) >> 3).T
        depth: dict[tuple, float] = defaultdict(float)
        light: dict[tuple, float] = {}
        total: dict[int, float] = defaultdict(float)
        for ray, brick, weight in zip(
            samples.ray.tolist(), map(tuple, bricks.tolist()), samples.weights.astype(float), strict=True
        ):
            left = np.exp(-total[ray])
            light.setdefault((ray, brick), left)
            own = -np.log(max(1 - weight / left, 1e-9))
            depth[ray, brick] += own
            total[ray] += own
        return depth, light

    fine, fine_light = segments(0)
    for level in (1, 2):
        coarse, coarse_light = segments(level)
        expected: dict[tuple, float] = defaultdict(float)
        for key in fine.keys() | coarse.keys():
            light = max(fine_light.get(key, 0.0), coarse_light.get(key, 0.0))
            change = np.exp(-coarse.get(key, 0.0)) - np.exp(-fine.get(key, 0.0))
            expected[key[1]] += (light * change) ** 2
        of_brick = [expected[tuple(c)] for c in pyramid.levels[0].coords.tolist()]
        assert sum(of_brick) > 1e-4
        # Rounding may put a sample on the border of two bricks into the other one.
        assert np.abs(found[level] - of_brick).sum() < 0.01 * sum(of_brick)


def stored_of(wanted: Wanted, grid: Grid, step: int) -> PyramidValues:
    """Return what is stored if bits cost next to nothing."""
    every = [np.ones(vertices.n, np.float32) for vertices in wanted.pyramid.vertices]
    return Choices(grid, wanted, every, np.ones(1), step).at(1e-9).stored


def test_where_nothing_changes_the_coarser_levels_are_shown_without_a_seam() -> None:
    """A ramp through the whole box is shown without a seam: its means are the ramp, at the rim too."""
    layout, slope = layout_of(np.ones((4, 4, 4), bool), 64, 64), np.array([1, 0, -1])
    ramp = (layout.features.index @ slope)[:, None].astype(np.int8)
    pyramid = pyramid_beneath(layout.features.pyramid)
    values = mean_values(pyramid, ramp, np.ones(len(ramp)))
    for level, vertices in enumerate(pyramid.vertices):
        assert np.abs(values[level][:, 0] - (vertices.index * 2**level) @ slope).max() < 1e-3
    half = (pyramid.levels[0].coords[:, 0] < 4) * 1.0
    choice = Choice(pyramid, (np.zeros(512), half, half))
    dropped = choice.dropped(0.0)
    assert np.bincount(choice.levels(dropped)).tolist() == [256, 0, 256]
    shown = choice.shown(dropped)
    stored = stored_of(wanted_values(choice, values, shown, False), "features", 1)
    fine, coarse = shown.vertices[0], shown.vertices[1]
    border = fine.on_border
    assert border.sum() == 65 * 65
    assert np.array_equal(stored.values[0][border], predicted(fine, coarse, stored.values[1])[border])
    assert np.abs(stored.values[0][:, 0] - fine.index @ slope).max() <= 1


@pytest.mark.parametrize("seed", range(4))
def test_what_is_stored_shows_each_place_by_the_level_that_was_chosen(seed: int) -> None:
    random = np.random.default_rng(seed)
    layout = layout_of(random.random((9, 9, 9)) < 0.3, 72, 36)
    codes = faint(layout, seed)
    pyramid = pyramid_beneath(layout.densities.pyramid)
    errors = np.cumsum(random.exponential(size=(4, len(pyramid.levels[0]))), axis=0)
    choice = Choice(pyramid, tuple(errors - errors[0]))
    values = mean_values(pyramid, codes, np.ones(len(codes)))
    n_levels = set()
    for share in (0.0, 0.3, 0.7, 0.95, 1.0):
        dropped = choice.dropped(choice.worth(share))
        levels, shown = choice.levels(dropped), choice.shown(dropped)
        for whole, left in zip(pyramid.vertices, shown.vertices, strict=True):
            assert (np.diff(whole.rows(left.index)) > 0).all(), "so rows are taken in their place"
        wanted = wanted_values(choice, [of_level.copy() for of_level in values], shown, True)
        stored = stored_of(wanted, "densities", 3)
        own = PyramidValues(shown, tuple(np.zeros((v.n, 1), np.int8) for v in shown.vertices))
        box = np.array(layout.aabb)
        built = build_grid(stored, own, box, layout.step, (1,) * len(shown.levels), layout.density_range)
        coords = pyramid.levels[0].coords.astype(np.int64)
        entries = built.entries((coords * 8).T)
        assert np.array_equal(entries & 7, levels) and (entries >= 0).all()
        n_levels |= set(levels.tolist())
        for fine, coarse, here, below in zip(
            shown.vertices, shown.vertices[1:], stored.values, stored.values[1:], strict=False
        ):
            border = fine.on_border
            assert np.array_equal(here[border], predicted(fine, coarse, below)[border])
    assert n_levels == {0, 1, 2, 3}


def test_nothing_is_dropped_for_nothing() -> None:
    visible = np.random.default_rng(1).random((9, 9, 9)) < 0.3
    pyramid = pyramid_beneath(layout_of(visible, 72, 36).densities.pyramid)
    errors = [np.full(len(pyramid.levels[0]), float(level)) for level in range(4)]
    choice = Choice(pyramid, tuple(errors))
    assert not choice.levels(choice.dropped(-np.inf)).any()
    assert (choice.levels(choice.dropped(np.inf)) == 3).all()
    tried: list[float] = []

    def lost(amount: float) -> Loss:
        tried.append(amount)
        return Loss(amount, 0.01)

    found = largest(lost, 0.0, 1.0, 0.3)
    assert found is not None and found.loss.worst <= 0.3 < found.loss.worst + 1 / 32
    assert len(tried) == 7
    assert largest(lost, 0.5, 1.0, 0.3) is None


def test_what_is_seen_counts_in_the_means() -> None:
    layout = some_layout(8, 37)
    codes = np.zeros((len(layout.features), 1), np.int8)
    grid = layout.grid(np.full(len(layout.densities), 255, np.float32), codes)
    pyramid = pyramid_beneath(layout.features.pyramid)
    heavy = heavy_vertices(levels_of_features(grid, pyramid, codes, 1), len(codes), rays_of(4))
    assert (heavy > 0).all() and heavy.max() > 50 * heavy.min()
    coarse = pyramid.vertices[1]
    finest = np.random.default_rng(0).integers(-99, 99, (len(codes), 1)).astype(np.int8)
    found = mean_values(pyramid, finest, heavy)[1]
    n_alone = 0
    for row in np.random.default_rng(1).choice(coarse.n, 200, replace=False):
        around = {}
        for offset in np.ndindex(3, 3, 3):
            away = tuple(np.array(offset) - 1)
            (at,) = pyramid.vertices[0].rows((coarse.index[row] * 2 + away)[None])
            if at >= 0:
                around[away] = float(heavy[at]) / 2 ** np.abs(away).sum(), float(finest[at, 0])
        total = weight = 0.0
        for away, (share, value) in around.items():
            opposite = tuple(-np.array(away))
            if opposite in around:
                less = min(share, around[opposite][0])
                total, weight = total + less * value, weight + less
        if not weight:
            total = sum(share * value for share, value in around.values())
            weight = sum(share for share, _ in around.values())
            n_alone += 1
        assert found[row, 0] == pytest.approx(total / weight, rel=1e-3, abs=1e-2)
    assert 0 < n_alone < 100
