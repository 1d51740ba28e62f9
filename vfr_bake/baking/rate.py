"""What an asset stores of refined values: as much of each as a picture shows of it, for a price of bits.

A level of a pyramid stores by how many steps its values differ from what the next coarser level says
(`player.asset.pyramid`). With the *importance* w_v of a vertex, the mean square by which a unit of its value
changes the colours of training rays, and d_v for how far the stored value is from the refined one, symbols
are chosen such that

    D + price R,    D = sum_v w_v d_v^2,    R = the bits of all symbols,

is small, level by level and vertex by vertex in the order in which they are coded. D leaves out that errors
of vertices which a ray meets together add up or cancel: the price is chosen by what pictures lose. It is the
highest at which they lose no more than they may, or the lowest at which the asset fits into the bytes that
were asked for.

Coarser levels that show nothing predict: their vertices weigh as much as all finer ones that they predict
together, each by its share. Of features they want the weighted mean of those; of densities the value at the
same place, because the density changes too fast at a surface for a mean to tell anything.
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
"""Few, because a ray through fog has hundreds of samples, of 100 to 200 bytes each meanwhile."""
N_RAYS = 500_000
"""Rays that tell how much vertices change what is seen, at most: more of them tell it better."""
AROUND: dict[Grid, float] = {"densities": 5.0, "features": 1.0}
"""What a vertex has more importance than those rays say, because others will meet it: a share of the mean
around it. What a density does depends more on the ray."""
EVERYWHERE: dict[Grid, float] = {"densities": 0.1, "features": 0.02}
"""The same as a share of the mean of all vertices."""
TURNS = 2
"""How often the symbols of a level are chosen: each time with what the ones before cost."""
STRENGTH = 16.0
"""How many symbols of a context it takes until they count as much as those of all contexts together."""
DECAY = (0.05, 0.12, 0.2, 0.3, 0.45, 0.6, 0.7, 0.8, 0.88)
"""Before any symbol is chosen: how much rarer a symbol is than the next smaller one, by the magnitudes of the
neighbours (the first factor of `player.asset.coder.tables.context`)."""


TABLES = 1.04
"""How many times as much symbols take in a file as they would with tables that are known: the tables."""


FIRST_PRICE = 1.5e-9
"""Price that is tried first, as a share of the model's mean square error: balanced objects end at
2e-9 to 5e-9, captures at 4e-10."""
LOWEST_PRICE = 1e-10
"""Price below which more bytes show next to nothing, as a share of the model's mean square error: at 3e-10 of
it fox's values take 8.0 MB, at 6e-11 of it 12.5 MB, which lose 0.02 dB less on test views."""
SLOPE, SLOPES = 0.7, (0.25, 2.0)
"""What a price loses grows with this power of it, before two prices tell the power; the least and the most
that it may be."""
FURTHEST = 16.0
"""Factor from one price to the next, at most."""
AIM, CLOSE = 0.9, 0.8
"""The next price is to lose this share of what it may; one that loses so much of it is near enough."""
NEAR = 1.4
"""So are two prices with this factor between them, of which the higher one loses too much."""
MOST_PRICES = 12
PRICES_TRIED = 3
"""How many prices are tried, mostly."""


class Importance(NamedTuple):
    """By how much a unit of stored values changes colours in [0, 1]: mean squares over rays and colour
    channels."""

    densities: np.ndarray
    """[n_densities] float32, for a unit of the code."""
    features: np.ndarray
    """[n_features] float32, for a unit in all channels, one after the other: the sum of the squares."""
    channels: np.ndarray
    """[n_channels] float64: the share of each channel in that; they add up to 1."""


def importance(
    stored: Stored,
    layout: Layout,
    grid: SparseGrid,
    teacher: TeacherRays,
    ranges: tuple[Range, ...] | None,
    background: np.ndarray,
) -> Importance:
    """How much each stored value matters on some of the teacher's rays, at every sample.

    The derivatives of a ray's three colours are not taken one by one: those of their sum with random signs
    have the same mean square.

    Args:
        stored: refined values and head.
        layout, grid: where they are, and the grid of the finest level that is played.
        teacher: rays.
        ranges: of the head's activations, where it multiplies in 8 bits.
        background: [3] behind the scene.

    Raises TrainingError where no ray meets anything.
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
    """What is stored at some price."""

    stored: PyramidValues
    distortion: float
    """D of the finest level: mean square error of colours that is expected."""
    n_bytes: float
    """What the symbols take."""


class Choices:
    """The values of a pyramid as they should be, and what is stored of them at different prices."""

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
            grid: what the pyramid holds.
            wanted: its cells, and the values of all levels; not copied.
            importance: [n] float32 of the vertices of each level.
            channels: [n_channels] factors of the importance.
            step: of the symbols of all levels.
        """
        self._limits, self._kind = LIMITS[grid], DTYPES[grid]
        self._pyramid, self._channels = wanted.pyramid, channels
        self._step, self._wanted, self._weights = step, wanted.values, importance
        vertices = wanted.pyramid.vertices
        self._places = [places_between(*two) for two in pairwise(vertices)]
        self._rows = [_all_rows(level_rows(of_level)) for of_level in vertices]

    def at(self, price: float) -> Chosen:
        """What is stored where a bit is worth a mean square error of `price`."""
        n_channels = self._wanted[0].shape[1]
        values = tuple(np.empty((len(wanted), n_channels), self._kind) for wanted in self._wanted)

        def channel(number: int) -> tuple[float, float]:
            return self._choose_channel(number, price, [level[:, number] for level in values])

        with ThreadPoolExecutor(get_num_threads()) as threads:
            found = list(threads.map(channel, range(n_channels)))
        distortion, bits = np.sum(found, axis=0).tolist()
        return Chosen(PyramidValues(self._pyramid, values), distortion, TABLES * bits / 8)

    def _choose_channel(self, number: int, price: float, out: Sequence[np.ndarray]) -> tuple[float, float]:
        """The distortion of the finest level and the bits of all."""
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
            inside = ~vertices.on_border  # what is on the border has no symbol
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
    """[3, n] int32 neighbours, n for one that is not there, and [n] uint8 classes."""
    neighbours = rows.neighbours.rows
    return np.where(neighbours < 0, np.int32(len(rows.classes)), neighbours), rows.classes


def first_bits() -> np.ndarray:
    """[n_classes * 81, 127] float32: what the symbols -63 to 63 may cost, before any is chosen."""
    lean = N_CONTEXTS // len(DECAY)
    powers = np.array(DECAY)[:, None] ** np.abs(np.arange(-END, END + 1))
    bits = -np.log2(powers / powers.sum(axis=1, keepdims=True))
    return np.tile(bits.repeat(lean, axis=0), (N_CLASSES, 1)).astype(np.float32)


def bits_of(seen: np.ndarray) -> np.ndarray:
    """What each symbol costs in each context [n_contexts, 127] float32, from how often it was `seen` there;
    contexts that hardly were follow the others."""
    every = seen.sum(axis=0) + 1e-4 * max(seen.sum(), 1) * 0.7 ** np.abs(np.arange(-END, END + 1))
    chance = seen + STRENGTH * every / every.sum()
    bits = -np.log2(chance / chance.sum(axis=1, keepdims=True))
    bits[:, [0, N_SYMBOLS - 1]] += 8  # and a byte for how much further from 0
    return bits.astype(np.float32)


class Spent(NamedTuple):
    """What is stored at some price."""

    arrays: GridArrays
    n_bytes: float
    """What densities and features take in the asset's files, roughly."""


def expected_importance(grid: Grid, pyramid: Pyramid, importance: np.ndarray) -> np.ndarray:
    """The importance [n] float32 of the finest level's vertices for other rays than those that it is from."""
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
    """The importance [n] float32 of the vertices of all levels of a whole pyramid, from that of the finest:
    those of a coarser level weigh as much as all that they predict together."""
    found = [expected_importance(grid, pyramid, importance)]
    for fine, coarse in pairwise(pyramid.vertices):
        found.append(np.zeros(coarse.n, np.float32))
        add_to_coarser(fine.bricks.masks, *places_between(fine, coarse), found[-2], found[-1])
    return found


class Prices:
    """Refined values, and what is stored of them at each price."""

    def __init__(self, layout: Layout, densities: Wanted, features: Wanted, matters: Importance) -> None:
        """
        Args:
            layout: the finest level.
            densities, features: what of it is shown, and what it should be.
            matters: how much the finest level's values matter.
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
        """What is stored where a bit is worth a mean square error of `price`."""
        densities, features = self._densities.at(price), self._features.at(price)
        return Spent(
            GridArrays(densities.stored, features.stored),
            self._structure_bytes + densities.n_bytes + features.n_bytes,
        )


def _shown_importance(grid: Grid, wanted: Wanted, whole: Pyramid, finest: np.ndarray) -> list[np.ndarray]:
    """The importance of the vertices that are left of the pyramid `whole`."""
    return [
        of_level[vertices.rows_of(left.bricks)]
        for of_level, vertices, left in zip(
            importance_of_levels(grid, whole, finest), whole.vertices, wanted.pyramid.vertices, strict=True
        )
    ]


def highest_price(share: Callable[[float], float], first: float, lowest: float = 0.0) -> float:
    """A price of which `share`, what is lost at it as a share of what may be, is little below 1.

    It rises with the price, about as a power of it, so that few of them have to be tried. Where it is above 1
    at all prices, or below it, the price found is far from `first`, but not below `lowest`.

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
            price = lowest  # does any price fit?
        else:
            price = max(_next_price(tried, low, high, price), lowest)
    return low or min(tried)


def _next_price(tried: dict[float, float], low: float, high: float, last: float) -> float:
    """Where the share is about AIM; it is known at `last`, and at `low` and `high` on either side of 1 where
    these are not 0 and infinite."""
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
