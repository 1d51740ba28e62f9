"""Which row of an array holds which vertex of a grid: rows are in the order of bricks, then of bits
(`player.bricks`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from player.bricks import bricks_per_axis, dense_index, stored_bits

ABSENT = 0xFFFF
"""The rank of a vertex that is not stored."""


@dataclass(frozen=True, eq=False)
class VertexRows:
    """Rows of the stored vertices of a grid. Letters: nb bricks per axis."""

    resolution: int
    """Cells per axis."""
    n_per_axis: int
    """nb."""
    bricks: np.ndarray
    """[nb^3] int32 at (bx * nb + by) * nb + bz: the brick that holds a vertex, -1 where there is none."""
    base: np.ndarray
    """[n_bricks] int32: row of the brick's first vertex."""
    ranks: np.ndarray
    """[n_bricks * 512] uint16 at brick * 512 + bit: row of the vertex counted from the base, ABSENT if it is
    not stored."""

    def find(self, index: np.ndarray) -> np.ndarray:
        """Rows [n] int64 of vertices [n, 3] that may lie outside; -1 where none is stored."""
        n = self.n_per_axis
        inside = np.all((index >= 0) & (index < 8 * n), axis=-1)
        x, y, z = np.where(inside[:, None], index, 0).T.astype(np.int64)
        brick = self.bricks[((x >> 3) * n + (y >> 3)) * n + (z >> 3)].astype(np.int64)
        held = np.maximum(brick, 0)
        rank = self.ranks[held * 512 + (x & 7) * 64 + (y & 7) * 8 + (z & 7)].astype(np.int64)
        return np.where(inside & (brick >= 0) & (rank != ABSENT), self.base[held] + rank, -1)


def vertex_rows(coords: np.ndarray, masks: np.ndarray, resolution: int) -> VertexRows:
    """Rows of the vertices of bricks as they are on disk.

    >>> from player.bricks import pack_vertices
    >>> coords, masks, _ = pack_vertices(np.array([[0, 0, 0], [9, 0, 0], [9, 0, 1]]))
    >>> vertex_rows(coords, masks, 16).find(np.array([[9, 0, 1], [0, 0, 0], [1, 0, 0], [-1, 0, 0]])).tolist()
    [2, 0, -1, -1]
    """
    n_per_axis = bricks_per_axis(resolution)
    stored = stored_bits(masks)
    counts = np.cumsum(stored, axis=1, dtype=np.uint16)
    totals = counts[:, -1].astype(np.int64) if len(stored) else np.zeros(0, np.int64)
    base = (np.cumsum(totals) - totals).astype(np.int32)
    counts -= np.uint16(1)
    counts[~stored] = ABSENT
    return VertexRows(
        resolution, n_per_axis, dense_index(coords, n_per_axis).reshape(-1), base, counts.reshape(-1)
    )
