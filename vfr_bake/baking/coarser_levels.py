"""Add coarser levels beneath a grid of one level. Once the whole asset is loaded, nothing is read from them.
They are what the asset's first part shows, and what the values of the finest level are predicted from."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np

from player.asset.parts import LIMITS
from player.asset.pyramid import (
    MAX_LEVELS,
    NO_BRICKS,
    Pyramid,
    PyramidValues,
    Vertices,
    symbols_of,
    values_of,
    whole_pyramid,
)
from player.asset.sections import Grid

COARSEST = 16
"""Most cells along each axis of the coarsest level, unless MAX_LEVELS are too few to get there."""


def pyramid_beneath(finest: Pyramid) -> Pyramid:
    """Return the pyramid of a grid of one level, `finest`, with coarser levels added.

    >>> from player.asset.pyramid import Bricks
    >>> one = Bricks(np.zeros((1, 3), np.uint16), np.ones((1, 8), np.uint64))
    >>> [len(level) for level in pyramid_beneath(Pyramid(64, (one,))).levels]
    [1, 1, 1]
    """
    n_coarser = 0
    while n_coarser + 1 < MAX_LEVELS and finest.resolution > COARSEST << n_coarser:
        n_coarser += 1
    return whole_pyramid(finest.resolution, [finest.levels[0], *[NO_BRICKS] * n_coarser])


def values_beneath(pyramid: Pyramid, finest: np.ndarray, grid: Grid, step: int = 1) -> PyramidValues:
    """Fill a pyramid that is shown by its finest level alone with the values `finest` [n_vertices,
    n_channels] of that level, as exactly as the quantization step `step` of the symbols allows.

    A coarser vertex gets the value of the finer vertex at the same place; if none is stored there, the mean
    of the finer vertices around it.
    """
    low, high = LIMITS[grid]
    values = [np.clip(finest, low, high)]
    for fine, coarse in pairwise(pyramid.vertices):
        values.append(_sampled(fine, coarse, values[-1]))
    if step > 1:
        steps = (step,) * len(values)
        symbols = symbols_of(pyramid.vertices, values, steps, LIMITS[grid])
        reached = values_of(pyramid.vertices, symbols, steps, LIMITS[grid])
        values = [level.astype(finest.dtype) for level in reached]
    return PyramidValues(pyramid, tuple(values))


def with_coarser_levels(stored: PyramidValues, grid: Grid) -> PyramidValues:
    """Return `stored`, with coarser levels added if it has only one level."""
    finest, *coarser = stored.values
    return stored if coarser else values_beneath(pyramid_beneath(stored.pyramid), finest, grid)


def _sampled(fine: Vertices, coarse: Vertices, values: np.ndarray) -> np.ndarray:
    """Return the values [n_coarse, n_channels] of the next coarser level: those of the finer vertices at the
    same places; if none is stored there, the mean of the finer vertices around, rounded."""
    places = coarse.index * 2
    rows = fine.rows(places)
    out = values[rows]
    alone = np.flatnonzero(rows < 0)
    total, n = np.zeros((len(alone), values.shape[1])), np.zeros((len(alone), 1))
    for offset in product((-1, 0, 1), repeat=3):
        beside = fine.rows(places[alone] + np.array(offset, np.int32))
        there = beside >= 0
        total[there] += values[beside[there]]
        n[there] += 1
    out[alone] = np.rint(total / n)  # n > 0: a live cell has this corner, and has a live finer cell in it
    return out
