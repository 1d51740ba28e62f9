"""Choose the level of a pyramid that shows each place: a coarser one where it looks nearly the same.

A bake begins with all values stored on the finest level. A brick of this level is dropped where the next
coarser level will do, which is then shown there. A brick of that level is dropped in turn, if all finer
bricks in it are dropped, up to COARSEST_SHOWN. Errors are those that the rays of many views see
(`vfr_bake.baking.detail.errors`). Let E_l(b) be the error of showing level l in place of the finest one in a
finest brick b, and n(b) the number of vertices of a brick. A brick b of level l is dropped if

    sum over the finest bricks in b of (E_{l+1} - E_l)  <=  worth n(b),

so that each vertex that stays saves an error of at least `worth`. `worth` is chosen by the loss of pictures.

The value of a coarser vertex is the weighted mean of the 3 x 3 x 3 finer vertices around it: the weights are
1, 2, 1 along each axis, times the given weight of each vertex. Vertices opposite each other both get the
lower given weight of the two, so that a linear ramp is preserved, even at the rim of the stored vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from player.asset.bricks import stored_bits
from player.asset.pyramid import NO_BRICKS, Bricks, Pyramid, Vertices, whole_pyramid

COARSEST_SHOWN = 3
"""The coarsest level that may show a place. One of its cells is as large as a brick of the finest level, so
that live cells never reach into places where the finest level has no brick."""
ROWS_AT_ONCE = 1 << 18

AROUND = np.array(list(np.ndindex(3, 3, 3)), np.int32) - 1
"""Offsets to a vertex and its neighbours."""
HALF = AROUND[13:]
"""The middle offset, and one offset of each opposite pair."""


def mean_values(pyramid: Pyramid, finest: np.ndarray, heavy: np.ndarray) -> list[np.ndarray]:
    """Compute the values of all levels, [n_vertices, n_channels] each: the finest first, the others as
    float32 means of finer values.

    Args:
        pyramid: a pyramid with the finest level and coarser levels beneath it.
        finest: [n_vertices, n_channels], the values of the finest level.
        heavy: [n_vertices] above 0, the weight of each vertex of the finest level in the means.
    """
    found, weights = [finest], heavy.astype(np.float32)
    for level in range(1, len(pyramid.levels)):
        fine, coarse = pyramid.vertices[level - 1], pyramid.vertices[level]
        total, of_total = np.empty((coarse.n, finest.shape[1]), np.float32), np.empty(coarse.n, np.float32)
        for first in range(0, coarse.n, ROWS_AT_ONCE):
            some = slice(first, first + ROWS_AT_ONCE)
            places = coarse.index[some] * 2
            total[some], of_total[some] = _around(fine, places, found[-1], weights, HALF)
            # Without pairs where neither the middle nor both vertices of an opposite pair are stored.
            alone = first + np.flatnonzero(of_total[some] == 0)
            total[alone], of_total[alone] = _around(fine, places[alone - first], found[-1], weights, AROUND)
            total[some] /= of_total[some, None]
        found.append(total)
        weights = of_total
    return found


def _around(
    fine: Vertices, places: np.ndarray, values: np.ndarray, weights: np.ndarray, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sum the finer `values` at `offsets` around `places` [n, 3], weighted. If `offsets` is HALF, each is
    summed together with its opposite, both with the lower weight of the two.

    Returns the weighted sums [n, n_channels], and the sums of the weights [n].
    """
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
    """A pyramid that shows its finest level, and the errors by dropping bricks of it."""

    pyramid: Pyramid
    errors: tuple[np.ndarray, ...]
    """For each level, from the finest one to the coarsest that may be shown, [n_bricks] float64: the error in
    each brick of the finest level if this level shows it; 0 for the finest level."""

    @cached_property
    def parents(self) -> list[np.ndarray]:
        """For each level but the coarsest, [n_bricks]: the brick of the next coarser level that contains each
        brick."""
        levels = self.pyramid.levels
        return [coarse.find(fine.coords >> 1) for fine, coarse in pairwise(levels)]

    @cached_property
    def _n_vertices(self) -> list[np.ndarray]:
        """For each level whose bricks may be dropped, [n_bricks]: the number of vertices of each brick, at
        least 1."""
        found = []
        for level in range(len(self.errors) - 1):
            vertices = self.pyramid.vertices[level].bricks
            n = stored_bits(vertices.masks_at(self.pyramid.levels[level].coords)).sum(axis=1)
            found.append(np.maximum(n, 1))
        return found

    @cached_property
    def _gains(self) -> list[np.ndarray]:
        """For each level whose bricks may be dropped, [n_bricks]: the error that is added if the brick is
        dropped, divided by the number of its vertices."""
        found = []
        bricks = np.arange(len(self.pyramid.levels[0]))  # for each finest brick, its brick of `level`
        for level, (own, coarser) in enumerate(zip(self.errors[:-1], self.errors[1:], strict=True)):
            size = len(self.pyramid.levels[level])
            found.append(np.bincount(bricks, coarser - own, size) / self._n_vertices[level])
            bricks = self.parents[level][bricks]
        return found

    def dropped(self, worth: float) -> list[np.ndarray]:
        """Choose the bricks to drop if a vertex is kept only for an error above `worth`. Returns [n_bricks]
        bool for each level whose bricks may be dropped."""
        found, whole = [], np.ones(len(self.pyramid.levels[0]), bool)
        for level, gains in enumerate(self._gains):
            found.append(whole & (gains <= worth))
            coarser = len(self.pyramid.levels[level + 1])
            whole = np.bincount(self.parents[level], ~found[-1], coarser) == 0
        return found

    def levels(self, dropped: Sequence[np.ndarray]) -> np.ndarray:
        """Return [n_bricks] int: the level that shows the place of each brick of the finest level, without
        the `dropped` bricks."""
        bricks = np.arange(len(self.pyramid.levels[0]))
        found = np.zeros(len(bricks), np.int64)
        for level, of_level in enumerate(dropped):
            found += of_level[bricks] & (found == level)
            bricks = self.parents[level][bricks]
        return found

    def shown(self, dropped: Sequence[np.ndarray]) -> Pyramid:
        """Return the pyramid without the `dropped` bricks."""
        levels = self.pyramid.levels
        leaves = [levels[0], *(NO_BRICKS,) * (len(levels) - 1)]
        for level, of_level in enumerate(dropped):
            kept = leaves[level].find(levels[level].coords) >= 0
            kept &= ~of_level
            leaves[level] = Bricks(levels[level].coords[kept], levels[level].masks[kept])
            under = np.unique(self.parents[level][of_level])
            coarser = levels[level + 1]
            leaves[level + 1] = Bricks(coarser.coords[under], coarser.masks[under])
        return whole_pyramid(self.pyramid.resolution, leaves)

    def worth(self, share: float) -> float:
        """Return the `worth` with which the dropped bricks have about a `share` of all vertices of the finest
        level."""
        order = np.argsort(self._gains[0])
        running = np.cumsum(self._n_vertices[0][order])
        return float(self._gains[0][order[np.searchsorted(running, share * running[-1])]])


class Wanted(NamedTuple):
    """The pyramid that remains to be shown, and the values that its vertices should have."""

    pyramid: Pyramid
    """The remaining cells."""
    values: list[np.ndarray]
    """For each level, [n_vertices, n_channels]: codes as floats, or latent features as int16."""


def wanted_values(choice: Choice, values: Sequence[np.ndarray], shown: Pyramid, sampled: bool) -> Wanted:
    """Return the wanted values of `shown`, the remaining part of the pyramid of `choice`.

    `values` are those of all levels of the whole pyramid, from `mean_values`; they are overwritten. With
    `sampled`, a coarser vertex with a finer vertex at the same place has the value of the finer one.
    """
    found: list[np.ndarray] = []
    for level, (whole, left) in enumerate(zip(choice.pyramid.vertices, shown.vertices, strict=True)):
        of_level = take_rows(values[level], whole.rows_of(left.bricks))
        if sampled and level:
            finer = shown.vertices[level - 1].rows(left.index * 2)
            of_level[finer >= 0] = found[-1][finer[finer >= 0]]
        found.append(of_level)
    return Wanted(shown, found)


def take_rows(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return `values[rows]` for ascending rows, moved to the front of `values` in place, because there may be
    no memory for a copy.

    >>> take_rows(np.arange(8), np.array([1, 4, 7])).tolist()
    [1, 4, 7]
    """
    for first in range(0, len(rows), ROWS_AT_ONCE):
        some = rows[first : first + ROWS_AT_ONCE]
        values[first : first + len(some)] = values[some]
    return values[: len(rows)]
