"""Multiresolution hash grid: features at points, and the gradient scattered back to the table (Mueller et al.
2022, section 3).

Letters: a level has `scale` cells per axis over the unit cube, and its entries start at row `offset` of
`table` [n_entries, n_channels]. If a level is `hashed`, its vertices share entries through the spatial hash;
otherwise each has its own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from player.compiled.prefetch import prefetch
from vfr_bake.kernels import njit

PRIME_Y = np.uint32(2654435761)
PRIME_Z = np.uint32(805459861)
ONE = np.uint32(1)
N_CHANNELS = 2
"""Feature channels per level, as in the paper; the loops below are written out for two."""

FLAGS = {"contract", "reassoc", "nsz", "arcp"}
"""Floating-point optimisations that are allowed. NaN and infinity keep their meaning, so that a bad step is
noticed."""
LARGE = 48
"""Cells per axis from which on a level, of a megabyte, is too large to stay in a core's cache."""
AHEAD = 4
"""Number of points by which the rows that a gradient is added to are prefetched ahead."""


class TableLevels(NamedTuple):
    """Levels of a table, and which of its rows belong to each: arrays for numba, tensors for torch."""

    scales: Any
    """[n_levels] cells per axis, in the table's type."""
    offsets: Any
    """[n_levels + 1] int64: first row of each level, and finally the number of all rows."""
    hashed: Any
    """[n_levels] bool: whether vertices share entries through the spatial hash."""
    mask: int
    """Number of entries of a hashed level, which is a power of two, minus one."""


class HashGridArrays(NamedTuple):
    """Hash grid in the form that kernels take."""

    table: np.ndarray
    """[n_entries, n_channels]."""
    scales: np.ndarray
    offsets: np.ndarray
    hashed: np.ndarray
    mask: int
    """This member and the three before it are those of `TableLevels`: a parallel kernel takes no nested
    tuples."""


@njit(inline="always")
def cell_of(position, last):
    """Return the cell, from 0 to `last`, that contains a position along one axis, given in cells."""
    return min(max(np.int32(position), np.int32(0)), last)


@njit(inline="always")
def corner_rows(ix, iy, iz, last, offset, mask, hashed):
    """Return the rows of the eight corners of the cell (ix, iy, iz), each from 0 to `last`, in the order 000
    100 010 110 001 101 011 111 (x fastest).

    Rows are unsigned: for a signed index, Numba would test whether it is negative and counts from the end.
    """
    x, y, z, first = np.uint32(ix), np.uint32(iy), np.uint32(iz), np.uint64(offset)
    if hashed:
        bits = np.uint32(mask)
        x1 = x + ONE
        y0, y1 = y * PRIME_Y, (y + ONE) * PRIME_Y
        z0, z1 = z * PRIME_Z, (z + ONE) * PRIME_Z
        a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        return (
            first + np.uint64(np.uint32(x ^ a) & bits),
            first + np.uint64(np.uint32(x1 ^ a) & bits),
            first + np.uint64(np.uint32(x ^ b) & bits),
            first + np.uint64(np.uint32(x1 ^ b) & bits),
            first + np.uint64(np.uint32(x ^ c) & bits),
            first + np.uint64(np.uint32(x1 ^ c) & bits),
            first + np.uint64(np.uint32(x ^ d) & bits),
            first + np.uint64(np.uint32(x1 ^ d) & bits),
        )
    side, one = np.uint64(last) + np.uint64(2), np.uint64(1)
    row = first + (np.uint64(z) * side + np.uint64(y)) * side + np.uint64(x)
    plane = side * side
    return (
        row,
        row + one,
        row + side,
        row + side + one,
        row + plane,
        row + plane + one,
        row + plane + side,
        row + plane + side + one,
    )


@njit(inline="always")
def corners(x, y, z, scale, offset, mask, hashed):
    """Return (rows, trilinear weights) of the eight corners around a point of the unit cube, in the order of
    `corner_rows`."""
    kind = type(scale)
    one = kind(1)
    last = np.int32(scale) - np.int32(1)
    px, py, pz = x * scale, y * scale, z * scale
    ix, iy, iz = cell_of(px, last), cell_of(py, last), cell_of(pz, last)
    fx, fy, fz = px - kind(ix), py - kind(iy), pz - kind(iz)
    gx, gy, gz = one - fx, one - fy, one - fz
    w00, w10, w01, w11 = gy * gz, fy * gz, gy * fz, fy * fz
    weights = (gx * w00, fx * w00, gx * w10, fx * w10, gx * w01, fx * w01, gx * w11, fx * w11)
    return corner_rows(ix, iy, iz, last, offset, mask, hashed), weights


@njit(inline="always")
def prefetch_corners(x, y, z, scale, offset, mask, hashed, array):
    """Prefetch the rows of `array` around a point, unless the level is so small that they are in the
    cache."""
    if scale < LARGE:
        return
    last = np.int32(scale) - np.int32(1)
    ix, iy, iz = cell_of(x * scale, last), cell_of(y * scale, last), cell_of(z * scale, last)
    rows = corner_rows(ix, iy, iz, last, offset, mask, hashed)
    for corner in range(8):
        prefetch(array, rows[corner])


@njit(fastmath=FLAGS, error_model="numpy")
def prefetch_point(x, y, z, grid):
    """Prefetch the rows around a point in all levels."""
    for level in range(grid.scales.shape[0]):
        prefetch_corners(
            x, y, z, grid.scales[level], grid.offsets[level], grid.mask, grid.hashed[level], grid.table
        )  # fmt: skip


@njit(fastmath=FLAGS, error_model="numpy")
def encode_point(x, y, z, grid, out):
    """Write the features [2 * n_levels] of one point of the unit cube to `out`."""
    prefetch_point(x, y, z, grid)
    table = grid.table
    for level in range(grid.scales.shape[0]):
        r, w = corners(
            x, y, z, grid.scales[level], grid.offsets[level], grid.mask, grid.hashed[level]
        )  # fmt: skip
        for channel in range(2):
            out[2 * level + channel] = (
                w[0] * table[r[0], channel]
                + w[1] * table[r[1], channel]
                + w[2] * table[r[2], channel]
                + w[3] * table[r[3], channel]
                + w[4] * table[r[4], channel]
                + w[5] * table[r[5], channel]
                + w[6] * table[r[6], channel]
                + w[7] * table[r[7], channel]
            )


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def encode(points, grid, out):
    """Write the features [n_points, 2 * n_levels] at `points` [n_points, 3] of the unit cube to `out`."""
    for i in prange(points.shape[0]):
        encode_point(points[i, 0], points[i, 1], points[i, 2], grid, out[i])


@njit(inline="always")
def scatter_level(points, grad_features, level, scale, offset, mask, hashed, grad_table, rows):
    """Add one level's gradient to `grad_table` [n_entries, 2]. List the rows that had no gradient before in
    `rows`, which has room for 8 per point and one more, and return their number.

    The list grows without a branch: what a row held is known only when it has arrived from memory, and a
    mispredicted branch would hold up the fetching of later rows.
    """
    n, n_points = np.uint64(0), points.shape[0]
    for i in range(n_points):
        ahead = min(i + AHEAD, n_points - 1)
        prefetch_corners(
            points[ahead, 0], points[ahead, 1], points[ahead, 2], scale, offset, mask, hashed, grad_table
        )  # fmt: skip
        g0, g1 = grad_features[i, 2 * level], grad_features[i, 2 * level + 1]
        if g0 == 0 and g1 == 0:
            continue
        r, w = corners(points[i, 0], points[i, 1], points[i, 2], scale, offset, mask, hashed)
        for corner in range(8):
            row = r[corner]
            old0, old1 = grad_table[row, 0], grad_table[row, 1]
            rows[n] = row
            n += np.uint64((old0 == 0) & (old1 == 0))
            grad_table[row, 0] = old0 + w[corner] * g0
            grad_table[row, 1] = old1 + w[corner] * g1
    return n


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def scatter(points, grad_features, levels, n_threads, grad_table):
    """Add the gradient of `encode` to `grad_table` [n_entries, 2], given `grad_features`
    [n_points, 2 * n_levels].

    Each level is owned by one thread: no two threads write to one entry, and sums are always in the same
    order, so that the result is the same in every run. Fine levels cost more than coarse ones, so
    neighbouring levels go to different threads.
    """
    scales, offsets, hashed, mask = levels
    n_levels = scales.shape[0]
    for thread in prange(n_threads):
        rows = np.empty(8 * points.shape[0] + 1, np.uint32)
        for level in range(thread, n_levels, n_threads):
            scatter_level(
                points, grad_features, level, scales[level], offsets[level], mask, hashed[level], grad_table,
                rows,
            )  # fmt: skip
