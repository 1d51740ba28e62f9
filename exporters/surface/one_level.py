"""Conversion of a pyramid to one grid of its finest level: surfaces and volumes are
made from cells of one size.

A coarse cell is replaced by the fine cells in its place. The codes at their corners are interpolated as the
format predicts them, in whole codes.
"""

from __future__ import annotations

import itertools

import numpy as np

from player.asset.bricks import BRICK, stored_bits
from player.asset.pyramid import Bricks, Pyramid, PyramidValues, packed_bits, predicted
from player.files.memory import check_memory

_OCTANTS = np.array(list(itertools.product((0, 1), repeat=3)))
_BYTES_A_BRICK = 4096
"""Bytes of memory that masks and coordinates of a brick take while it is made."""
_BYTES_A_VERTEX = 80
"""Bytes of memory that a vertex takes while its density is interpolated; 69 to 70 were measured on objects
and on captures."""


def one_level(stored: PyramidValues, allowed: int, where: str) -> PyramidValues:
    """Return the pyramid of one level that shows what `stored` shows, with as many cells along each axis.

    Args:
        stored: a pyramid of any number of levels, and its codes.
        allowed: bytes of memory that the result may take.
        where: the beginning of an error message.

    Raises ConfigError: the result takes more memory than is allowed.
    """
    pyramid = stored.pyramid
    last = len(pyramid.levels) - 1
    vertices, values = pyramid.vertices[last], stored.values[last]
    cells, kind = pyramid.levels[last], values.dtype
    for level in reversed(range(last)):
        cells = _refined(pyramid, level, cells, allowed, where)
        coarse, vertices = vertices, Pyramid(pyramid.cells_per_axis(level), (cells,)).vertices[0]
        check_memory(_BYTES_A_VERTEX * vertices.n * max(stored.n_channels // 8, 1), allowed, where)
        values = predicted(vertices, coarse, values).astype(kind)
        rows = pyramid.vertices[level].rows(vertices.index)
        values[rows >= 0] = stored.values[level][rows[rows >= 0]]
    return PyramidValues(Pyramid(pyramid.resolution, (cells,)), (values,))


def _refined(pyramid: Pyramid, level: int, coarser: Bricks, allowed: int, where: str) -> Bricks:
    """Return the bricks of `level` that cover what is shown there and in `coarser`, the
    bricks of the next level."""
    check_memory(_BYTES_A_BRICK * 8 * len(coarser), allowed, where)
    n_cells = pyramid.cells_per_axis(level)
    coords = (2 * coarser.coords.astype(np.int64)[:, None] + _OCTANTS).reshape(-1, 3)
    coords = np.unique(coords[(coords * BRICK < n_cells).all(axis=1)], axis=0)
    masks = pyramid.shown(level, coords)
    edge = np.flatnonzero(((coords + 1) * BRICK > n_cells).any(axis=1))
    local = np.argwhere(np.ones((BRICK,) * 3, bool))
    inside = (coords[edge, None] * BRICK + local < n_cells).all(axis=-1)
    masks[edge] = packed_bits(stored_bits(masks[edge]) & inside)
    return Bricks(coords.astype(np.uint16), masks).without_empty()
