"""Multiresolution hash grid: features at points, and their gradient scattered back (Mueller et al. 2022,
section 3).

Letters: a level has `scale` cells per axis over the unit cube, its entries start at row `offsets[level]` of
`table` [n_entries, 2]; `hashed[level]` tells whether vertices share entries through the spatial hash or have
one each.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

PRIME_Y = 2654435761
PRIME_Z = 805459861
N_CHANNELS = 2
"""Feature channels per level, as in the paper; the loops below are written out for two."""

FLAGS = {"contract", "reassoc", "nsz", "arcp"}
"""Floating-point liberties for speed. NaN and infinity keep their meaning, so that a bad step is seen, not
hidden."""


@njit(inline="always")
def corner_rows(ix, iy, iz, side, offset, mask, hashed):
    """Rows of the eight corners, in the order 000 100 010 110 001 101 011 111 (x fastest)."""
    if hashed:
        y0 = iy * PRIME_Y
        z0 = iz * PRIME_Z
        y1 = y0 + PRIME_Y
        z1 = z0 + PRIME_Z
        jx = ix + 1
        return (
            offset + ((ix ^ y0 ^ z0) & mask),
            offset + ((jx ^ y0 ^ z0) & mask),
            offset + ((ix ^ y1 ^ z0) & mask),
            offset + ((jx ^ y1 ^ z0) & mask),
            offset + ((ix ^ y0 ^ z1) & mask),
            offset + ((jx ^ y0 ^ z1) & mask),
            offset + ((ix ^ y1 ^ z1) & mask),
            offset + ((jx ^ y1 ^ z1) & mask),
        )
    row = offset + (iz * side + iy) * side + ix
    plane = side * side
    return (
        row,
        row + 1,
        row + side,
        row + side + 1,
        row + plane,
        row + plane + 1,
        row + plane + side,
        row + plane + side + 1,
    )


@njit(fastmath=FLAGS, error_model="numpy")
def encode_point(x, y, z, table, scales, offsets, hashed, mask, out):
    """Write the features [2 * n_levels] of one point of the unit cube to `out`."""
    kind = table.dtype.type
    one = kind(1)
    for level in range(scales.shape[0]):
        scale = scales[level]
        last = np.int64(scale) - 1
        px, py, pz = x * scale, y * scale, z * scale
        ix = min(max(np.int64(px), 0), last)
        iy = min(max(np.int64(py), 0), last)
        iz = min(max(np.int64(pz), 0), last)
        fx, fy, fz = px - kind(ix), py - kind(iy), pz - kind(iz)
        gx, gy, gz = one - fx, one - fy, one - fz
        r0, r1, r2, r3, r4, r5, r6, r7 = corner_rows(
            ix, iy, iz, last + 2, offsets[level], mask, hashed[level]
        )
        w00, w10, w01, w11 = gy * gz, fy * gz, gy * fz, fy * fz
        for channel in range(2):
            out[2 * level + channel] = (
                w00 * (gx * table[r0, channel] + fx * table[r1, channel])
                + w10 * (gx * table[r2, channel] + fx * table[r3, channel])
                + w01 * (gx * table[r4, channel] + fx * table[r5, channel])
                + w11 * (gx * table[r6, channel] + fx * table[r7, channel])
            )


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def encode(points, table, scales, offsets, hashed, mask, out):
    """Features `out` [n_points, 2 * n_levels] at `points` [n_points, 3] of the unit cube."""
    for i in prange(points.shape[0]):
        encode_point(points[i, 0], points[i, 1], points[i, 2], table, scales, offsets, hashed, mask, out[i])


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def scatter(points, grad_features, scales, offsets, hashed, mask, n_threads, grad_table, rows, counts):
    """Add to `grad_table` [n_entries, 2] the gradient of `encode`, given `grad_features` [n_points, 2 *
    n_levels].

    One thread owns a level: no two threads write to one entry, and the sum has one order, so the result is
    the same in every run. Fine levels cost more than coarse ones, so neighbouring levels go to different
    threads. Entries whose gradient was zero are listed in `rows[level, : counts[level]]`; `rows` has room for
    8 a point.
    """
    kind = grad_table.dtype.type
    one = kind(1)
    n_levels = scales.shape[0]
    for thread in prange(n_threads):
        for level in range(thread, n_levels, n_threads):
            scale = scales[level]
            last = np.int64(scale) - 1
            n = 0
            for i in range(points.shape[0]):
                g0, g1 = grad_features[i, 2 * level], grad_features[i, 2 * level + 1]
                if g0 == 0 and g1 == 0:
                    continue
                px, py, pz = points[i, 0] * scale, points[i, 1] * scale, points[i, 2] * scale
                ix = min(max(np.int64(px), 0), last)
                iy = min(max(np.int64(py), 0), last)
                iz = min(max(np.int64(pz), 0), last)
                fx, fy, fz = px - kind(ix), py - kind(iy), pz - kind(iz)
                gx, gy, gz = one - fx, one - fy, one - fz
                corners = corner_rows(ix, iy, iz, last + 2, offsets[level], mask, hashed[level])
                weights = (
                    gx * gy * gz,
                    fx * gy * gz,
                    gx * fy * gz,
                    fx * fy * gz,
                    gx * gy * fz,
                    fx * gy * fz,
                    gx * fy * fz,
                    fx * fy * fz,
                )
                for corner in range(8):
                    row = corners[corner]
                    if grad_table[row, 0] == 0 and grad_table[row, 1] == 0:
                        rows[level, n] = row
                        n += 1
                    grad_table[row, 0] += weights[corner] * g0
                    grad_table[row, 1] += weights[corner] * g1
            counts[level] = n
