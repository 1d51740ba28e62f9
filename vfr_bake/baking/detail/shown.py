"""Which level of a pyramid shows a place: a coarser one where it says the same.

A bake begins with all that is stored on the finest level. A brick of it is dropped where the next coarser
level serves as well, so that this one is shown there; and so is a brick of that level, if all finer ones
in it are dropped, up to COARSEST_SHOWN. What counts is what the rays of many views see. With E_l(b) for the
error that showing level l in place of the finest makes in the brick b, and n(b) for its vertices, a brick b
of level l is dropped if

    sum over the finest bricks in b of (E_{l+1} - E_l)  <=  worth n(b),

so that every vertex that stays is worth that much of the error. How much that is the pictures decide.

A level says what the next finer one says around: the mean of 3 x 3 x 3 vertices with the weights 1, 2, 1
along each axis, times how much each matters. Vertices opposite each other count alike, as the one that
matters less, so that a ramp stays the ramp that it is, also at the rim of what is stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from player.asset.bricks import stored_bits
from player.asset.pyramid import Bricks, Pyramid, Vertices, whole_pyramid

COARSEST_SHOWN = 3
"""The coarsest level that may show a place: one of its cells is a brick of the finest level, so that live
cells never reach into places where the finest level has no brick."""
ROWS_AT_ONCE = 1 << 18

AROUND = np.array(list(np.ndindex(3, 3, 3)), np.int32) - 1
"""Offsets to a vertex and its neighbours."""
HALF = AROUND[13:]
"""The middle, and one of each two that are opposite each other."""

_NONE = Bricks(np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64))


def mean_values(pyramid: Pyramid, finest: np.ndarray, heavy: np.ndarray) -> list[np.ndarray]:
    """The values of all levels, [n_vertices, n_channels] each, the finest first and the others as float32.

    Args:
        pyramid: of a finest level and what lies beneath.
        finest: [n_vertices, n_channels], the values of the finest level.
        heavy: [n_vertices] above 0, how much each of them matters.
    """
    found, weights = [finest], heavy.astype(np.float32)
    for level in range(1, len(pyramid.levels)):
        fine, coarse = pyramid.vertices[level - 1], pyramid.vertices[level]
        total, of_total = np.empty((coarse.n, finest.shape[1]), np.float32), np.empty(coarse.n, np.float32)
        for first in range(0, coarse.n, ROWS_AT_ONCE):
            some = slice(first, first + ROWS_AT_ONCE)
            places = coarse.index[some] * 2
            total[some], of_total[some] = _around(fine, places, found[-1], weights, HALF)
            alone = first + np.flatnonzero(of_total[some] == 0)  # nothing is stored there, nor all around
            total[alone], of_total[alone] = _around(fine, places[alone - first], found[-1], weights, AROUND)
            total[some] /= of_total[some, None]
        found.append(total)
        weights = of_total
    return found


def _around(
    fine: Vertices, places: np.ndarray, values: np.ndarray, weights: np.ndarray, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The weighted sums [n, n_channels] of values around places [n, 3], and the sums of the weights [n]:
    of what is at `offsets` and, if that is HALF, of what is opposite; each as much as the one of the two that
    matters less."""
    sums, n = np.zeros((len(places), values.shape[1]), np.float32), np.zeros(len(places), np.float32)
    for offset in offsets:
        rows = fine.rows(places + offset)
        share = np.where(rows >= 0, weights[rows], np.float32(0))
        if offsets is HALF:
            opposite = fine.rows(places - offset)
            share = np.minimum(share, np.where(opposite >= 0, weights[opposite], np.float32(0)))
            share *= np.float32(1 if offset.any() else 0.5)  # the middle is its own opposite
        share *= np.float32(0.5 ** np.abs(offset).sum())
        sums += share[:, None] * values[rows]
        n += share
        if offsets is HALF:
            sums += share[:, None] * values[opposite]
            n += share
    return sums, n


@dataclass(frozen=True, eq=False)
class Choice:
    """What may be dropped of a pyramid that shows its finest level, and what that costs."""

    pyramid: Pyramid
    errors: tuple[np.ndarray, ...]
    """For each level from the finest on, of which nothing is known to be wrong, to the coarsest that may be
    shown, [n_bricks] float64: the error in each brick of the finest level where this level shows it."""

    @cached_property
    def parents(self) -> list[np.ndarray]:
        """For each level but the coarsest, [n_bricks]: which brick of the next coarser level each is in."""
        levels = self.pyramid.levels
        return [coarse.find(fine.coords >> 1) for fine, coarse in pairwise(levels)]

    @cached_property
    def _n_vertices(self) -> list[np.ndarray]:
        """For each level that may be dropped [n_bricks]: the vertices of each brick, 1 or more."""
        found = []
        for level in range(len(self.errors) - 1):
            vertices = self.pyramid.vertices[level].bricks
            n = stored_bits(vertices.masks_at(self.pyramid.levels[level].coords)).sum(axis=1)
            found.append(np.maximum(n, 1))
        return found

    @cached_property
    def _gains(self) -> list[np.ndarray]:
        """For each level that may be dropped [n_bricks]: the error that a brick's being dropped adds, for
        each of its vertices."""
        found = []
        bricks = np.arange(len(self.pyramid.levels[0]))  # of each level, those that the finest ones are in
        for level, (own, coarser) in enumerate(zip(self.errors[:-1], self.errors[1:], strict=True)):
            size = len(self.pyramid.levels[level])
            found.append(np.bincount(bricks, coarser - own, size) / self._n_vertices[level])
            bricks = self.parents[level][bricks]
        return found

    def dropped(self, worth: float) -> list[np.ndarray]:
        """For each level that may be dropped, [n_bricks] bool: which bricks are, where a vertex is worth so
        much of the error."""
        found, whole = [], np.ones(len(self.pyramid.levels[0]), bool)
        for level, gains in enumerate(self._gains):
            found.append(whole & (gains <= worth))
            coarser = len(self.pyramid.levels[level + 1])
            whole = np.bincount(self.parents[level], ~found[-1], coarser) == 0
        return found

    def levels(self, dropped: Sequence[np.ndarray]) -> np.ndarray:
        """[n_bricks] int: the level that shows the place of each brick of the finest level."""
        bricks = np.arange(len(self.pyramid.levels[0]))
        found = np.zeros(len(bricks), np.int64)
        for level, of_level in enumerate(dropped):
            found += of_level[bricks] & (found == level)
            bricks = self.parents[level][bricks]
        return found

    def shown(self, dropped: Sequence[np.ndarray]) -> Pyramid:
        """The pyramid without the bricks that are dropped."""
        levels = self.pyramid.levels
        leaves = [levels[0], *(_NONE,) * (len(levels) - 1)]
        for level, of_level in enumerate(dropped):
            kept = leaves[level].find(levels[level].coords) >= 0
            kept &= ~of_level
            leaves[level] = Bricks(levels[level].coords[kept], levels[level].masks[kept])
            under = np.unique(self.parents[level][of_level])
            coarser = levels[level + 1]
            leaves[level + 1] = Bricks(coarser.coords[under], coarser.masks[under])
        return whole_pyramid(self.pyramid.resolution, leaves)

    def worth(self, share: float) -> float:
        """The worth of a vertex at which bricks are dropped that have about `share` of all vertices of the
        finest level."""
        order = np.argsort(self._gains[0])
        running = np.cumsum(self._n_vertices[0][order])
        return float(self._gains[0][order[np.searchsorted(running, share * running[-1])]])


class Wanted(NamedTuple):
    """What is shown of a pyramid, and the values that its vertices should have."""

    pyramid: Pyramid
    """The cells that are left."""
    values: list[np.ndarray]
    """For each level [n_vertices, n_channels]: codes as floats, or latent features as int16."""


def wanted_values(choice: Choice, values: Sequence[np.ndarray], shown: Pyramid, sampled: bool) -> Wanted:
    """The values where `shown` is left of the pyramid of `choice`, from those of all levels of the whole
    pyramid, as `mean_values` finds them; they are changed. If they are `sampled`, a coarser vertex that has a
    finer one at its place has the value of that."""
    found: list[np.ndarray] = []
    for level, (whole, left) in enumerate(zip(choice.pyramid.vertices, shown.vertices, strict=True)):
        of_level = take_rows(values[level], whole.rows_of(left.bricks))
        if sampled and level:
            finer = shown.vertices[level - 1].rows(left.index * 2)
            of_level[finer >= 0] = found[-1][finer[finer >= 0]]
        found.append(of_level)
    return Wanted(shown, found)


def take_rows(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """`values[rows]` of ascending rows, in the place of `values`: there may be no room for them twice.

    >>> take_rows(np.arange(8), np.array([1, 4, 7])).tolist()
    [1, 4, 7]
    """
    for first in range(0, len(rows), ROWS_AT_ONCE):
        some = rows[first : first + ROWS_AT_ONCE]
        values[first : first + len(some)] = values[some]
    return values[: len(rows)]
