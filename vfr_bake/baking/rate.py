"""Rate-distortion optimisation of the stored codes: choose the symbols that an asset stores, at a price for
each bit.

A symbol is the number of quantization steps by which a value of a pyramid's level differs from its prediction
by the next coarser level (`player.asset.pyramid`). Let the *importance* w_v of a vertex be the mean square by
which a unit of its value changes the colours of training rays, and d_v the difference between the stored and
the refined value. Symbols are chosen such that

    D + price R,    D = sum_v w_v d_v^2,    R = the bits of all symbols,

is small, level by level and vertex by vertex in the order in which they are coded. D ignores that errors of
vertices that lie on the same ray add up or cancel. So the price is chosen by the measured loss of pictures:
the highest price at which they lose no more than allowed, or the lowest one at which the asset fits into the
bytes that were asked for.

Vertices of coarser levels that are not shown serve as predictors. Their importance is the sum of that of all
finer vertices that they predict, by their shares in the prediction. The value wanted for a coarser feature is
the weighted mean of the finer ones; for a coarser density it is the value at the same place, because density
changes too fast at a surface for a mean to predict anything.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numba import get_num_threads

from exporters.head.onnx_head import Range
from player.asset.asset import GridArrays
from player.asset.coder.tables import CONTEXT_OF_SUM, END, MIXED, N_CONTEXTS, N_SYMBOLS
from player.asset.grid import SparseGrid
from player.asset.parts import DTYPES, LIMITS
from player.asset.prediction.prediction import values_from
from player.asset.pyramid import Pyramid, PyramidValues, places_between
from player.asset.sections import Grid
from player.asset.structure import encode_structure
from player.asset.symbols import N_CLASSES, LevelRows, level_rows
from vfr_bake.baking.detail.shown import Wanted
from vfr_bake.baking.distillation import TeacherRays, collect_training_rays
from vfr_bake.baking.grids import Layout, codes
from vfr_bake.baking.head import FoldedHead
from vfr_bake.baking.refinement import Stored
from vfr_bake.kernels.stored_features import padded, slants
from vfr_bake.kernels.symbols import add_squares, add_to_coarser, choose, from_coarser

RAYS_AT_ONCE = 1 << 12
"""Kept small: a ray through fog has hundreds of samples, and each takes 100 to 200 bytes while they are
processed."""
N_RAYS = 500_000
"""Most rays from which the importance is computed; more rays make it more exact."""
AROUND: dict[Grid, float] = {"densities": 5.0, "features": 1.0}
"""Importance added to each vertex, as a share of the mean importance around it, because rays that were not
drawn will meet it, too. It is larger for densities, whose effect depends more on the ray."""
EVERYWHERE: dict[Grid, float] = {"densities": 0.1, "features": 0.02}
"""Importance added to each vertex, as a share of the mean importance of all vertices."""
TURNS = 2
"""Times that a level's symbols are chosen, each time with the bit costs that follow from the last choice."""
STRENGTH = 16.0
"""Weight of the statistics of all contexts in those of a single context, as a number of symbols: a context
with this many symbols of its own weighs both alike."""
DECAY = (0.05, 0.12, 0.2, 0.3, 0.45, 0.6, 0.7, 0.8, 0.88)
"""Assumed before any symbol is chosen: the frequency of a symbol relative to that of the next smaller
magnitude, by the magnitudes of the neighbours (the first factor of `player.asset.coder.tables.context`)."""


TABLES = 1.04
"""Factor on the bytes of the symbols in a file that accounts for the probability tables stored with them."""


FIRST_PRICE = 1.5e-9
"""Price that is tried first, as a share of the model's mean square error. The final prices are 2e-9 to 5e-9
for balanced objects, and 4e-10 for captures."""
LOWEST_PRICE = 1e-10
"""Lowest price, as a share of the model's mean square error: below it, more bytes show next to nothing. Fox's
values take 8.0 MB at 3e-10, and 12.5 MB at 6e-11, where they lose 0.02 dB less on test views."""
SLOPE, SLOPES = 0.7, (0.25, 2.0)
"""The loss is taken to grow with a power of the price: with the exponent SLOPE at first, then with the one
that follows from two prices, limited to the range SLOPES."""
FURTHEST = 16.0
"""Largest factor from one tried price to the next."""
AIM, CLOSE = 0.9, 0.8
"""Share of the allowed loss that the next price aims at; and share from which a price is near enough."""
NEAR = 1.4
"""The search also ends at two prices with at most this factor between them, if the higher one loses too
much."""
MOST_PRICES = 12
PRICES_TRIED = 3
"""Typical number of prices that are tried."""


class Importance(NamedTuple):
    """The importance of stored values: the squares by which a unit of a value changes colours in [0, 1],
    averaged over rays and colour channels."""

    densities: np.ndarray
    """[n_densities] float32, for a unit of the density code."""
    features: np.ndarray
    """[n_features] float32, the sum over channels of the importance of a unit of each channel's code."""
    channels: np.ndarray
    """[n_channels] float64: the share of each channel in `features`; they add up to 1."""


def importance(
    stored: Stored,
    layout: Layout,
    grid: SparseGrid,
    teacher: TeacherRays,
    ranges: tuple[Range, ...] | None,
    background: np.ndarray,
) -> Importance:
    """Compute the importance of each stored value on up to N_RAYS of the teacher's rays, with feature lookups
    at every sample.

    The three colour channels of a ray are not differentiated one by one. Instead, their sum with random signs
    is: its derivatives have the same mean square.

    Args:
        stored: refined values and head.
        layout: the layout of the values.
        grid: the grid that the player makes of the finest level.
        teacher: rays.
        ranges: ranges of the head's activations, if it multiplies in 8 bits.
        background: [3] colour behind the scene.

    Raises TrainingError if no ray meets anything.
    """
    densities = grid.rows if layout.densities is layout.features else layout.densities.rows()
    rays = collect_training_rays(teacher.some(N_RAYS), grid, 0, densities)
    head, random = FoldedHead(stored.head, ranges=ranges), np.random.default_rng(0)
    of_densities, of_features = (np.zeros(len(v), np.float32) for v in (stored.density, stored.features))
    changed = np.zeros_like(of_densities), np.zeros_like(of_features)
    n_channels = stored.features.shape[1]
    of_channels = np.zeros(n_channels)
    behind = torch.from_numpy(background.astype(np.float32))
    for first in range(0, len(rays), RAYS_AT_ONCE):
        some = np.arange(first, min(first + RAYS_AT_ONCE, len(rays)))
        fetches = rays.fetches(some)
        values = fetches.interpolate(stored.features)
        composed = torch.from_numpy(fetches.composite(values, n_channels)).requires_grad_()
        opacity = torch.from_numpy(fetches.opacity).requires_grad_()
        shown = (head(composed, torch.from_numpy(rays.teacher.rays_d[some])) - behind) * opacity[:, None]
        signs = torch.from_numpy(random.choice(np.array([-1, 1], np.float32), (len(some), 3)))
        along, along_opacity = torch.autograd.grad((shown * signs).sum(), (composed, opacity))
        gradient = np.zeros((len(some), padded(n_channels)), np.float32)
        gradient[:, :n_channels] = along.numpy()
        squares = gradient[:, :n_channels].astype(np.float64) ** 2
        of_channels += squares.sum(axis=0)
        size = np.sqrt(squares.sum(axis=1)).astype(np.float32)
        slopes = np.repeat(size, np.diff(fetches.starts)) * fetches.weights
        add_squares(fetches.starts, *fetches.features, slopes, changed[1], of_features)
        slopes = np.empty(len(fetches.weights), np.float32)
        slants(
            fetches.starts, *fetches.densities, fetches.weights, fetches.opacity, values, gradient,
            along_opacity.numpy(), grid.density_low, grid.density_slope, fetches.lengths, stored.density,
            slopes,
        )  # fmt: skip
        add_squares(fetches.starts, *fetches.densities, slopes, changed[0], of_densities)
    n = np.float32(3 * len(rays))
    total = of_channels.sum()
    shares = of_channels / total if total > 0 else np.full(len(of_channels), 1 / len(of_channels))
    return Importance(of_densities / n, of_features / n, shares)


class Chosen(NamedTuple):
    """The values of a pyramid that are stored at some price."""

    stored: PyramidValues
    distortion: float
    """D of the finest level: the expected mean square error of colours."""
    n_bytes: float
    """Expected bytes of the symbols in the file."""


class Choices:
    """The wanted values of a pyramid, from which the values to store are chosen at any price."""

    def __init__(
        self,
        grid: Grid,
        wanted: Wanted,
        importance: Sequence[np.ndarray],
        channels: np.ndarray,
        step: int = 1,
    ) -> None:
        """
        Args:
            grid: the grid that the pyramid belongs to: densities or features.
            wanted: the pyramid's cells, and the wanted values of all levels; not copied.
            importance: for each level [n] float32, the importance of its vertices.
            channels: [n_channels] factors on the importance.
            step: quantization step of the symbols of all levels.
        """
        self._limits, self._kind = LIMITS[grid], DTYPES[grid]
        self._pyramid, self._channels = wanted.pyramid, channels
        self._step, self._wanted, self._weights = step, wanted.values, importance
        vertices = wanted.pyramid.vertices
        self._places = [places_between(*two) for two in pairwise(vertices)]
        self._rows = [_all_rows(level_rows(of_level)) for of_level in vertices]

    def at(self, price: float) -> Chosen:
        """Choose the values to store if saving a bit is worth a mean square error of `price`."""
        n_channels = self._wanted[0].shape[1]
        values = tuple(np.empty((len(wanted), n_channels), self._kind) for wanted in self._wanted)

        def channel(number: int) -> tuple[float, float]:
            return self._choose_channel(number, price, [level[:, number] for level in values])

        with ThreadPoolExecutor(get_num_threads()) as threads:
            found = list(threads.map(channel, range(n_channels)))
        distortion, bits = np.sum(found, axis=0).tolist()
        return Chosen(PyramidValues(self._pyramid, values), distortion, TABLES * bits / 8)

    def _choose_channel(self, number: int, price: float, out: Sequence[np.ndarray]) -> tuple[float, float]:
        """Choose channel `number` of all levels into `out`. Returns the distortion of the finest level and
        the bits of all levels."""
        bits, distortion, coarse = 0.0, 0.0, np.zeros((0, 1), np.int16)
        factor = np.float32(self._channels[number] / price)
        none = np.zeros((0, 1), np.int16)
        for level in reversed(range(len(out))):
            vertices, (neighbours, classes) = self._pyramid.vertices[level], self._rows[level]
            if level + 1 < len(out):
                predicted = values_from(
                    vertices.bricks.masks, vertices.border, self._places[level], coarse, none, 1, (0, 0),
                    np.int16,
                )[:, 0]  # fmt: skip
            else:
                predicted = np.zeros(vertices.n, np.int16)
            inside = ~vertices.on_border  # vertices on the border have no symbols
            wanted = np.clip(codes(self._wanted[level][inside, number]), *self._limits)
            weights, near = self._weights[level][inside] * factor, np.zeros(len(wanted) + 1, np.int16)
            values, cost = np.empty(len(wanted), np.int16), first_bits()
            for _ in range(TURNS):
                seen = np.zeros(cost.shape, np.int64)
                weighed, _ = choose(
                    wanted, predicted[inside], weights, neighbours, classes, cost, CONTEXT_OF_SUM, MIXED,
                    (self._step, *self._limits), near, values, seen,
                )  # fmt: skip
                cost = bits_of(seen)
            distortion, bits = weighed * price, bits + float((seen * cost).sum())
            predicted[inside] = values
            out[level][:] = predicted
            coarse = predicted[:, None]
        return distortion, bits


def _all_rows(rows: LevelRows) -> tuple[np.ndarray, np.ndarray]:
    """Return [3, n] int32 rows of the neighbours, n for a missing one, and [n] uint8 classes."""
    neighbours = rows.neighbours.rows
    return np.where(neighbours < 0, np.int32(len(rows.classes)), neighbours), rows.classes


def first_bits() -> np.ndarray:
    """Return [n_classes * 81, 127] float32: the assumed bits of the symbols -63 to 63 in each context, before
    any symbol is chosen."""
    lean = N_CONTEXTS // len(DECAY)
    powers = np.array(DECAY)[:, None] ** np.abs(np.arange(-END, END + 1))
    bits = -np.log2(powers / powers.sum(axis=1, keepdims=True))
    return np.tile(bits.repeat(lean, axis=0), (N_CLASSES, 1)).astype(np.float32)


def bits_of(seen: np.ndarray) -> np.ndarray:
    """Return [n_contexts, 127] float32: the bits of each symbol in each context, from the number of times it
    was `seen` there. Contexts with few symbols follow the statistics of all contexts."""
    every = seen.sum(axis=0) + 1e-4 * max(seen.sum(), 1) * 0.7 ** np.abs(np.arange(-END, END + 1))
    chance = seen + STRENGTH * every / every.sum()
    bits = -np.log2(chance / chance.sum(axis=1, keepdims=True))
    bits[:, [0, N_SYMBOLS - 1]] += 8  # the end symbols are followed by a byte for the rest
    return bits.astype(np.float32)


class Spent(NamedTuple):
    """The densities and features that are stored at some price."""

    arrays: GridArrays
    n_bytes: float
    """Expected bytes of densities and features in the asset's files."""


def expected_importance(grid: Grid, pyramid: Pyramid, importance: np.ndarray) -> np.ndarray:
    """Return the expected importance [n] float32 of the finest level's vertices for rays other than those
    from which `importance` was computed."""
    mean = importance.mean(dtype=np.float64)
    everywhere, share = np.float32(EVERYWHERE[grid] * mean), np.float32(AROUND[grid])
    if len(pyramid.levels) == 1:
        return importance + everywhere + share * np.float32(mean)
    fine, coarse = pyramid.vertices[:2]
    masks, places = fine.bricks.masks, places_between(fine, coarse)
    around, n = np.zeros((2, coarse.n), np.float32)
    add_to_coarser(masks, *places, importance, around)
    add_to_coarser(masks, *places, np.ones_like(importance), n)
    around /= n
    out = np.empty_like(importance)
    from_coarser(masks, *places, around, out)
    out *= share
    out += importance + everywhere
    return out


def importance_of_levels(grid: Grid, pyramid: Pyramid, importance: np.ndarray) -> list[np.ndarray]:
    """Return for each level of a whole pyramid the importance [n] float32 of its vertices, from the
    `importance` of the finest level. The importance of finer vertices is passed on to the coarser vertices
    that predict them."""
    found = [expected_importance(grid, pyramid, importance)]
    for fine, coarse in pairwise(pyramid.vertices):
        found.append(np.zeros(coarse.n, np.float32))
        add_to_coarser(fine.bricks.masks, *places_between(fine, coarse), found[-2], found[-1])
    return found


class Prices:
    """The refined densities and features, from which the values to store are chosen at any price."""

    def __init__(self, layout: Layout, densities: Wanted, features: Wanted, matters: Importance) -> None:
        """
        Args:
            layout: the layout of the finest level.
            densities, features: the cells that are shown, and the wanted values.
            matters: importance of the finest level's values.
        """
        pyramids = layout.pyramids
        self._densities = Choices(
            "densities",
            densities,
            _shown_importance("densities", densities, pyramids.densities, matters.densities),
            np.ones(1),
            layout.density_step,
        )
        self._features = Choices(
            "features",
            features,
            _shown_importance("features", features, pyramids.features, matters.features),
            matters.channels,
        )
        self._structure_bytes = sum(
            len(encode_structure(wanted.pyramid, level))
            for wanted in (densities, features)
            for level in range(len(wanted.pyramid.levels))
        )

    def at(self, price: float) -> Spent:
        """Choose the values to store if saving a bit is worth a mean square error of `price`."""
        densities, features = self._densities.at(price), self._features.at(price)
        return Spent(
            GridArrays(densities.stored, features.stored),
            self._structure_bytes + densities.n_bytes + features.n_bytes,
        )


def _shown_importance(grid: Grid, wanted: Wanted, whole: Pyramid, finest: np.ndarray) -> list[np.ndarray]:
    """Return for each level the importance of the vertices of `wanted`, which is a part of the pyramid
    `whole`, from the importance `finest` of the whole finest level."""
    return [
        of_level[vertices.rows_of(left.bricks)]
        for of_level, vertices, left in zip(
            importance_of_levels(grid, whole, finest), whole.vertices, wanted.pyramid.vertices, strict=True
        )
    ]


def highest_price(share: Callable[[float], float], first: float, lowest: float = 0.0) -> float:
    """Search for a price at which `share`, such as the loss divided by the allowed loss, is little below 1.

    The share is taken to rise with the price, roughly as a power of it, so that few prices have to be tried.
    If it is above 1 at all prices, or below 1 at all, the price returned is far from `first`, but not below
    `lowest`.

    >>> 0.2 < highest_price(lambda price: (price / 0.3) ** 0.5, 1.0) <= 0.3
    True
    >>> highest_price(lambda price: 2.0, 1.0, lowest=0.05)
    0.05
    """
    tried: dict[float, float] = {}
    price, low, high = first, 0.0, math.inf
    while len(tried) < MOST_PRICES:
        found = tried[price] = share(price)
        low, high = (max(low, price), high) if found <= 1 else (low, min(high, price))
        if CLOSE <= found <= 1 or high <= max(NEAR * low, lowest):
            break
        if lowest and not low and len(tried) > 1:
            price = lowest  # check whether any price fits
        else:
            price = max(_next_price(tried, low, high, price), lowest)
    return low or min(tried)


def _next_price(tried: dict[float, float], low: float, high: float, last: float) -> float:
    """Return a price at which the share is expected to be about AIM.

    The share is known at the prices in `tried`, of which `last` is the latest. It is at most 1 at `low`,
    unless that is 0, and above 1 at `high`, unless that is infinite.
    """
    if low and high < math.inf:
        little, much = tried[low], tried[high]
        way = math.log(AIM / little) / math.log(much / little) if little > 0 else 0.5
        return float(low * (high / low) ** np.clip(way, 0.2, 0.8))
    found, slope = tried[last], SLOPE
    if len(tried) > 1:
        before = list(tried)[-2]
        if min(found, tried[before]) > 0 and max(found, tried[before]) < math.inf:
            slope = np.clip(math.log(found / tried[before]) / math.log(last / before), *SLOPES)
    factor = (AIM / found) ** (1 / slope) if found > 0 else FURTHEST
    return float(last * np.clip(factor, 1 / FURTHEST, FURTHEST))
