"""Which row of an array holds which vertex of a grid: rows are in the order of bricks, then of bits
(`player.asset.bricks`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from player.asset.bricks import bricks_per_axis, dense_index, stored_bits, with_apron, with_corners


@dataclass(frozen=True, eq=False)
class VertexRows:
    """Rows of the stored vertices of a grid. Letters: nb bricks per axis."""

    resolution: int
    """Cells per axis."""
    n_per_axis: int
    """nb."""
    bricks: np.ndarray
    """[nb^3] int32 at (bx * nb + by) * nb + bz: the brick that holds a cell, -1 where no corner of any cell
    is stored."""
    rows: np.ndarray
    """[n_bricks * 729] int32 at brick * 729 + x * 81 + y * 9 + z, x, y, z = 0..8: the row of a vertex, -1 if
    it is not stored. Bricks have an apron, so that the eight corners of a cell are in one."""

    def find(self, index: np.ndarray) -> np.ndarray:
        """Rows [n] int64 of vertices [n, 3] that may lie outside; -1 where none is stored."""
        n = self.n_per_axis
        inside = np.all((index >= 0) & (index < 8 * n), axis=-1)
        x, y, z = np.where(inside[:, None], index, 0).T.astype(np.int64)
        brick = self.bricks[((x >> 3) * n + (y >> 3)) * n + (z >> 3)].astype(np.int64)
        row = self.rows[np.maximum(brick, 0) * 729 + (x & 7) * 81 + (y & 7) * 9 + (z & 7)]
        return np.where(inside & (brick >= 0), row, -1).astype(np.int64)


def vertex_rows(coords: np.ndarray, masks: np.ndarray, resolution: int) -> VertexRows:
    """Rows of the vertices of bricks as they are on disk; at least one is stored.

    >>> from player.asset.bricks import pack_vertices
    >>> coords, masks, _ = pack_vertices(np.array([[0, 0, 0], [9, 0, 0], [9, 0, 1]]))
    >>> vertex_rows(coords, masks, 16).find(np.array([[9, 0, 1], [0, 0, 0], [1, 0, 0], [-1, 0, 0]])).tolist()
    [2, 0, -1, -1]
    """
    n_per_axis = bricks_per_axis(resolution)
    stored = stored_bits(masks)
    rows = np.full((len(stored) + 1, stored.shape[1]), -1, np.int32)
    rows[:-1][stored] = np.arange(np.count_nonzero(stored), dtype=np.int32)
    held = with_corners(coords, masks, n_per_axis)
    apron = np.empty((len(held), 9, 9, 9), np.int32)
    with_apron(rows, held, dense_index(coords, n_per_axis), apron)
    bricks = dense_index(held, n_per_axis).reshape(-1)
    return VertexRows(resolution, n_per_axis, bricks, apron.reshape(-1))
