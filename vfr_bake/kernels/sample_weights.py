"""Sums of the weights of rays' samples, as the player marches them, in the blocks and at the vertices of a
stored grid."""

from __future__ import annotations

from vfr_bake.kernels import njit

BLOCKS = 4
"""Number of blocks, two cells wide, along each edge of a brick."""


@njit(cache=True, error_model="numpy")
def add_block_weights(points, weights, table, n_per_axis, resolution, totals):
    """Add the `weights` [n] of samples to `totals` [n_slots * BLOCKS**3] float64: each to the slot, and its
    block of 2 x 2 x 2 cells, that contain the sample's point in `points` [n, 3], given in cells of the finest
    level.

    `table` is that of a grid of one level with `n_per_axis` bricks and `resolution` cells along an axis.
    """
    last = resolution - 1
    for i in range(len(weights)):
        x = min(max(int(points[i, 0]), 0), last)
        y = min(max(int(points[i, 1]), 0), last)
        z = min(max(int(points[i, 2]), 0), last)
        slot = table[((x >> 3) * n_per_axis + (y >> 3)) * n_per_axis + (z >> 3)] >> 3
        if slot >= 0:  # rounding may put a point into the brick beside its own
            block = ((x & 7) >> 1) * 16 + ((y & 7) >> 1) * 4 + ((z & 7) >> 1)
            totals[slot * 64 + block] += weights[i]


@njit(cache=True)
def add_corner_weights(rows, shares, weights, totals):
    """Add the `weights` [n] of samples to `totals` [n_vertices], divided among the eight corners `rows`
    [n, 8] around each sample by their `shares` [n, 8]."""
    for i in range(rows.shape[0]):
        for corner in range(8):
            totals[rows[i, corner]] += weights[i] * shares[i, corner]
