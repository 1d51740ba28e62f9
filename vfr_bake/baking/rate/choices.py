"""The choice of the values to store, level by level and vertex by vertex, at a price for each bit
(`vfr_bake.baking.rate`)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import get_num_threads

from player.asset.coder.tables import CONTEXT_OF_SUM, END, MIXED, N_CONTEXTS, N_SYMBOLS
from player.asset.parts import DTYPES, LIMITS
from player.asset.prediction.prediction import values_from
from player.asset.pyramid import PyramidValues, places_between
from player.asset.sections import Grid
from player.asset.symbols import N_CLASSES, LevelRows, level_rows
from vfr_bake.baking.detail.shown import Wanted
from vfr_bake.baking.grids import codes
from vfr_bake.kernels.symbols import choose

FIRST_TURNS = 2
"""Times that a level's symbols are chosen at the first price, each time with the bit costs that follow from
the last choice. At other prices they are chosen once, with the costs that followed from the price before."""
STRENGTH = 16.0
"""Weight of the statistics of all contexts in those of a single context, as a number of symbols: a context
with this many symbols of its own weighs both alike."""
DECAY = (0.05, 0.12, 0.2, 0.3, 0.45, 0.6, 0.7, 0.8, 0.88)
"""Assumed before any symbol is chosen: the frequency of a symbol relative to that of the next smaller
magnitude, by the magnitudes of the neighbours (the first factor of `player.asset.coder.tables.context`)."""
TABLES = 1.04
"""Factor on the bytes of the symbols in a file that accounts for the probability tables stored with them."""


class ChosenValues(NamedTuple):
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
        self._bits: dict[tuple[int, int], np.ndarray] = {}
        """The bits of symbols (`bits_of`) that followed from the last choice, by channel and level."""

    def at(self, price: float) -> ChosenValues:
        """Choose the values to store if saving a bit is worth a mean square error of `price`."""
        n_channels = self._wanted[0].shape[1]
        values = tuple(np.empty((len(wanted), n_channels), self._kind) for wanted in self._wanted)

        def channel(number: int) -> tuple[float, float]:
            return self._choose_channel(number, price, [level[:, number] for level in values])

        with ThreadPoolExecutor(get_num_threads()) as threads:
            found = list(threads.map(channel, range(n_channels)))
        distortion, bits = np.sum(found, axis=0).tolist()
        return ChosenValues(PyramidValues(self._pyramid, values), distortion, TABLES * bits / 8)

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
            values, cost = np.empty(len(wanted), np.int16), self._bits.get((number, level))
            turns = FIRST_TURNS if cost is None else 1
            cost = first_bits() if cost is None else cost
            for _ in range(turns):
                seen = np.zeros(cost.shape, np.int64)
                weighed, _ = choose(
                    wanted, predicted[inside], weights, neighbours, classes, cost, CONTEXT_OF_SUM, MIXED,
                    (self._step, *self._limits), near, values, seen,
                )  # fmt: skip
                cost = bits_of(seen)
            self._bits[number, level] = cost
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
