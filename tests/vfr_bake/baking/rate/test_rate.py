"""Values that are stored at a price of bits: how much each matters, and which symbols are worth it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from player.asset.coder.tables import CONTEXT_OF_SUM, MIXED
from player.asset.parts import LIMITS
from player.asset.pyramid import Bricks, Pyramid, places_between, symbols_of, values_of
from player.asset.sections import Grid
from player.asset.symbols import encode_level, level_rows
from tests.player.asset.coder.oracle import context
from vfr_bake.baking import bake
from vfr_bake.baking.coarser_levels import pyramid_beneath
from vfr_bake.baking.detail.shown import Wanted, mean_values
from vfr_bake.baking.distillation import TrainingRays, collect_training_rays
from vfr_bake.baking.grids import latent, whole_codes
from vfr_bake.baking.head import runner
from vfr_bake.baking.rate.choices import Choices, bits_of, first_bits
from vfr_bake.baking.rate.importance import AROUND, EVERYWHERE, importance, importance_of_levels
from vfr_bake.baking.rate.price import CLOSE, FURTHEST, MOST_PRICES, NEAR, highest_price
from vfr_bake.config import BakeConfig
from vfr_bake.kernels.symbols import add_squares, add_to_coarser, choose, from_coarser
from vfr_bake.training.model_file import Model


def sphere() -> Pyramid:
    """Return the cells near a sphere, on three levels."""
    cells = np.stack(np.meshgrid(*[np.arange(48)] * 3, indexing="ij"), axis=-1)
    live = np.abs(np.linalg.norm(cells - 23.5, axis=-1) - 18) < 1.5
    bricks = live.reshape(6, 8, 6, 8, 6, 8).transpose(0, 2, 4, 1, 3, 5).reshape(216, 512)
    masks = np.packbits(bricks, axis=1, bitorder="little").view(np.uint64)
    coords = np.stack(np.meshgrid(*[np.arange(6)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    finest = Bricks(coords.astype(np.uint16), masks).without_empty()
    return pyramid_beneath(Pyramid(48, (finest,)))


def wavy(pyramid: Pyramid, n_channels: int) -> np.ndarray:
    """Return smooth values with noise, [n, n_channels] float32, on the finest level."""
    random, places = np.random.default_rng(1), pyramid.vertices[0].index / 10
    waves = [20 * np.sin(places @ random.normal(size=3)) / (1 + c) for c in range(n_channels)]
    return (np.stack(waves, axis=-1) + random.normal(0, 2, (len(places), n_channels))).astype(np.float32)


def expected(grid: Grid, pyramid: Pyramid, importance: np.ndarray) -> np.ndarray:
    """Return the importance [n] float64 of the finest level, with the shares of importance around each vertex
    and of its mean added."""
    fine, coarse = pyramid.vertices[:2]
    around = [coarse.rows((fine.index + np.array(offset)) >> 1) for offset in product((0, 1), repeat=3)]
    total, n = np.zeros(coarse.n), np.zeros(coarse.n)
    for rows in around:
        np.add.at(total, rows, importance)
        np.add.at(n, rows, 1)
    near = np.mean([(total / n)[rows] for rows in around], axis=0)
    return importance + AROUND[grid] * near + EVERYWHERE[grid] * importance.mean()


def test_squares_are_of_what_a_vertex_does_to_a_whole_ray() -> None:
    # Compared with a float64 loop. A ray meets a vertex twice, some rays have no fetches, some shares are 0.
    random = np.random.default_rng(0)
    starts = np.array([0, 3, 3, 10, 11])
    rows = random.integers(0, 9, (11, 8)).astype(np.int32)
    shares = random.random((11, 8)).astype(np.float32)
    shares[random.random((11, 8)) < 0.3] = 0
    slopes = random.normal(size=11).astype(np.float32)
    found, changed = np.zeros(9, np.float32), np.zeros(9, np.float32)
    add_squares(starts, rows, shares, slopes, changed, found)
    wanted = np.zeros(9)
    for first, end in pairwise(starts):
        ray = np.zeros(9)
        for j, corner in product(range(first, end), range(8)):
            ray[rows[j, corner]] += float(slopes[j]) * float(shares[j, corner])
        wanted += ray**2
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    assert not changed.any()


def test_coarser_vertices_get_the_shares_by_which_they_predict() -> None:
    pyramid, random = sphere(), np.random.default_rng(0)
    fine, coarse = pyramid.vertices[:2]
    values, found = random.random(fine.n).astype(np.float32), np.zeros(coarse.n, np.float32)
    add_to_coarser(fine.bricks.masks, *places_between(fine, coarse), values, found)
    wanted = np.zeros(coarse.n)
    for offset in product((0, 1), repeat=3):
        np.add.at(wanted, coarse.rows((fine.index + np.array(offset)) >> 1), values / 8)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    # And back: a fine vertex gets the mean of the eight around it.
    coarser, found = random.random(coarse.n).astype(np.float32), np.empty(fine.n, np.float32)
    from_coarser(fine.bricks.masks, *places_between(fine, coarse), coarser, found)
    around = [coarse.rows((fine.index + np.array(offset)) >> 1) for offset in product((0, 1), repeat=3)]
    np.testing.assert_allclose(found, np.mean([coarser[rows] for rows in around], axis=0), rtol=1e-5)


@pytest.mark.parametrize("step", [1, 6])
def test_symbols_are_chosen_one_after_the_other(step: int) -> None:
    """Each symbol is the best of 0, the nearest symbol, and the next one towards 0, as in a plain loop."""
    random, n = np.random.default_rng(2), 400
    wanted = random.normal(0, 20, n).astype(np.float32)
    wanted[:3] = (400, -400, 127)
    predicted = random.integers(-127, 128, n).astype(np.int16)
    weights = np.where(random.random(n) < 0.1, 0, random.exponential(2, n)).astype(np.float32)
    neighbours = np.array([[random.integers(-1, v) if v else -1 for v in range(n)] for _ in range(3)])
    neighbours = np.where(neighbours < 0, n, neighbours).astype(np.int32)
    classes = random.integers(0, 4, n).astype(np.uint8)
    bits = (first_bits() + random.random(first_bits().shape)).astype(np.float32)
    found, seen = np.empty(n, np.int16), np.zeros(bits.shape, np.int64)
    distortion, rate = choose(
        wanted, predicted, weights, neighbours, classes, bits, CONTEXT_OF_SUM, MIXED, (step, -127, 127),
        np.zeros(n + 1, np.int16), found, seen,
    )  # fmt: skip
    symbols, total_distortion, total_rate, counts = np.zeros(n + 1, int), 0.0, 0.0, np.zeros(bits.shape, int)
    for v in range(n):
        at = int(classes[v]) * 81 + context(symbols[neighbours[:, v]].tolist())
        nearest = int(np.rint((wanted[v] - predicted[v]) / np.float32(step)))
        tried = {0, nearest, nearest - int(np.sign(nearest))}
        costs = {}
        for s in tried:
            if -127 <= predicted[v] + step * s <= 127:
                square = float(weights[v]) * (float(wanted[v]) - int(predicted[v]) - step * s) ** 2
                costs[s] = square + bits[at, np.clip(s, -63, 63) + 63], square
        s = (int(found[v]) - int(predicted[v])) // step
        assert found[v] == predicted[v] + step * s
        assert s in costs and costs[s][0] <= min(costs.values())[0] * (1 + 1e-5)
        symbols[v] = s
        total_distortion += costs[s][1]
        total_rate += bits[at, np.clip(s, -63, 63) + 63]
        counts[at, np.clip(s, -63, 63) + 63] += 1
    assert (distortion, rate) == pytest.approx((total_distortion, total_rate), rel=1e-4)
    np.testing.assert_array_equal(seen, counts)


def test_bits_are_those_of_what_was_seen() -> None:
    seen = np.zeros((324, 127), np.int64)
    seen[7, 63], seen[7, 64] = 3000, 1000
    bits = bits_of(seen)
    assert bits[7, 63] == pytest.approx(np.log2(4 / 3), abs=0.01) and bits[7, 64] == pytest.approx(
        2, abs=0.01
    )
    assert (bits > 0).all() and np.isfinite(bits).all() and np.isfinite(bits_of(np.zeros_like(seen))).all()
    # In a context in which nothing was seen, symbols cost what they do elsewhere; the last, a byte more.
    np.testing.assert_allclose(bits[8, 62:66], bits[9, 62:66])
    assert abs(bits[8, 63] - bits[7, 63]) < 0.1 and bits[8, 126] > bits[8, 125] + 8


@pytest.mark.parametrize(("grid", "step"), [("features", 1), ("features", 3), ("densities", 6)])
def test_a_higher_price_takes_fewer_bytes_and_no_less_distortion(grid: Grid, step: int) -> None:
    pyramid = sphere()
    n_channels = 3 if grid == "features" else 1
    wanted = wavy(pyramid, n_channels) + (0 if grid == "features" else 100)
    random = np.random.default_rng(0)
    weights = random.exponential(1, len(wanted)).astype(np.float32)
    weights[random.random(len(weights)) < 0.2] = 0
    levels, matters = levels_of(pyramid, wanted), importance_of_levels(grid, pyramid, weights)
    choices = Choices(grid, levels, matters, np.linspace(1, 0.5, n_channels), step)
    before = None
    for price in 0.01 * 10.0 ** np.arange(6):
        found = choices.at(price)
        values = found.stored.values
        # The values follow from the symbols, and take about as many bytes as stated.
        steps, limits = (step,) * len(values), LIMITS[grid]
        symbols = symbols_of(pyramid.vertices, values, steps, limits)
        for level, again in enumerate(values_of(pyramid.vertices, symbols, steps, limits)):
            np.testing.assert_array_equal(again, values[level])
        coded = [encode_level(s, level_rows(v)) for s, v in zip(symbols, pyramid.vertices, strict=True)]
        assert found.n_bytes == pytest.approx(sum(map(len, coded)), rel=0.25, abs=1500)
        weighed = expected(grid, pyramid, weights)[:, None] * np.linspace(1, 0.5, n_channels)
        distortion = float((weighed * (values[0] - wanted) ** 2).sum())
        assert found.distortion == pytest.approx(distortion, rel=1e-3)
        if before is None and step == 1:
            assert np.abs(values[0] - wanted).max() < 3
        if before is not None:  # a choice changes what the next ones cost: a percent of chance
            assert found.n_bytes < before.n_bytes and found.distortion > 0.99 * before.distortion
        before = found
    assert not symbols[0].any()


def levels_of(pyramid: Pyramid, finest: np.ndarray) -> Wanted:
    """Return a pyramid whose coarser levels are the means of its finest level."""
    return Wanted(pyramid, mean_values(pyramid, finest, np.ones(len(finest))))


def test_what_nobody_sees_is_almost_free() -> None:
    pyramid = sphere()
    wanted = wavy(pyramid, 2)
    seen = pyramid.vertices[0].index[:, 0] < 24
    weights = seen.astype(np.float32)
    values = (
        Choices(
            "features",
            levels_of(pyramid, wanted),
            importance_of_levels("features", pyramid, weights),
            np.ones(2),
        )
        .at(1.0)
        .stored.values
    )
    away = np.abs(values[0] - wanted).mean(axis=1)
    assert away[seen].mean() < 1.3 < 1.5 < away[~seen].mean()


def test_importance_is_the_mean_square_of_derivatives(model: Model) -> None:
    """Importance agrees with float64 differences of the played colours, for the vertices that matter most."""
    config = BakeConfig(resolution=40, feature_resolution=32, n_channels=6, check_views=1)
    work = bake._Bake(model, config, lambda *_: None)
    layout, _ = work._cells()
    stored, teacher, _ = work._store(layout, 40_000)
    grid = layout.grid(stored.density, stored.features)
    found = importance(stored, layout, grid, teacher, None, model.background)
    assert found.channels.sum() == pytest.approx(1) and (found.channels > 0).all()
    assert (found.features >= 0).all() and (found.densities >= 0).all()
    rays = collect_training_rays(teacher, grid, 0)
    head, fetches = runner(stored.head), rays.fetches(np.arange(len(rays)))

    def colours(features: np.ndarray, of: TrainingRays) -> np.ndarray:
        composed, opacity = of.composed(features)
        rgb = head(composed, of.teacher.rays_d).astype(np.float64) - model.background
        return rgb * opacity[:, None]

    # Ranks are denser at the top, where importance falls fastest; it has to differ by more than its error.
    ranks = np.union1d(np.geomspace(1, 400, 14).astype(int), np.arange(40, 400, 40))
    some, codes = np.argsort(found.features)[-ranks], whole_codes(stored.features)
    changes = []
    for row in some:
        at = np.flatnonzero((fetches.features.rows == row).any(axis=1))  # other rays' colours do not change
        near = np.unique(np.searchsorted(fetches.starts, at, side="right") - 1)
        meeting = replace(rays, teacher=rays.teacher.chosen(near), kept=None)
        total, base = 0.0, colours(latent(codes), meeting)
        for channel in range(stored.features.shape[1]):
            moved = codes.copy()
            moved[row, channel] += 1
            total += float(((colours(latent(moved), meeting) - base) ** 2).sum()) / (3 * len(rays))
        changes.append(total)
    # Signs are random: a vertex that some hundred rays meet is known to a fifth, all together better.
    assert found.features[some].sum() == pytest.approx(np.sum(changes), rel=0.2)
    assert np.corrcoef(np.log(found.features[some]), np.log(changes))[0, 1] > 0.7


@pytest.mark.parametrize("power", [0.3, 0.7, 1.5])
@pytest.mark.parametrize("first", [1e-5, 0.2, 1.0, 1e4])
def test_a_price_is_found_from_either_side(first: float, power: float) -> None:
    tried = []

    def share(price: float) -> float:
        tried.append(price)
        return (price / 0.3) ** power

    found = highest_price(share, first)
    assert found in tried and len(tried) <= MOST_PRICES
    assert CLOSE <= share(found) <= 1 or (found <= 0.3 <= NEAR * found)
    assert len(tried) <= (4 if 0.1 < first < 3 else 9)


def test_a_price_is_found_where_shares_are_no_power_of_it() -> None:
    """A price is found even if the loss jumps, from nothing up to some price to too much beyond it."""
    found = highest_price(lambda price: 0.0 if price < 0.3 else np.inf, 1.0)
    assert found < 0.3 <= NEAR * found
    assert highest_price(lambda _: -1.0, 1.0) == pytest.approx(FURTHEST ** (MOST_PRICES - 1))
    for much in (5.0, np.inf):
        assert highest_price(lambda _, much=much: much, 1.0, lowest=0.001) == 0.001
    assert highest_price(lambda _: 5.0, 1.0) < 1e-5
