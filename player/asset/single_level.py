"""Pyramids of one level, made from the stored vertices of a grid in versions 3.x of the format.

In these versions a brick is 8 x 8 x 8 vertices, and a cell is live where all eight of its corners are stored.
In a pyramid a brick is 8 x 8 x 8 cells, and the vertices are the corners of the live cells. A vertex that is
a corner of no live cell is therefore left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.asset.bricks import stored_bits
from player.asset.pyramid import Bricks, Pyramid, PyramidValues, live_cells


class VertexBricks(NamedTuple):
    """Bricks of vertices and the values stored at these, as versions 3.x of the format write a grid."""

    coords: np.ndarray
    """[n_bricks, 3] uint16, sorted."""
    masks: np.ndarray
    """[n_bricks, 8] uint64: which vertices are stored."""
    values: np.ndarray
    """[n_vertices] or [n_vertices, n_channels] uint8 or int8 codes, by brick and then by bit."""


def from_vertices(stored: VertexBricks, resolution: int) -> PyramidValues:
    """Return the pyramid of one level whose live cells are those with all eight corners stored.

    Args:
        stored: vertices and their values; values of one channel may be [n_vertices].
        resolution: cells along each axis.

    >>> from player.asset.bricks import pack_vertices
    >>> corners = np.argwhere(np.ones((2, 2, 2)))
    >>> coords, masks, _ = pack_vertices(np.concatenate([corners, [[1, 1, 2]]]))
    >>> codes = np.arange(9, dtype=np.uint8)
    >>> found = from_vertices(VertexBricks(coords, masks, codes), 4)
    >>> int(stored_bits(found.pyramid.levels[0].masks).sum()), found.values[0][:, 0].tolist()
    (1, [0, 1, 2, 3, 4, 5, 6, 7])
    """
    masks = np.asarray(stored.masks, np.uint64)
    values = stored.values[:, None] if stored.values.ndim == 1 else stored.values
    pyramid = Pyramid(resolution, (live_cells(Bricks(np.asarray(stored.coords), masks)),))
    kept = pyramid.vertices[0].bricks.masks_at(stored.coords)
    if not np.array_equal(kept, masks):
        values = values[stored_bits(kept)[stored_bits(masks)]]
    return PyramidValues(pyramid, (values,))
