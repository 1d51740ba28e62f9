"""Compositing of stored codes as the player does it, and gradient descent on the codes.

Letters: ray i has the fetches starts[i] to starts[i + 1], in the order of the ray. Fetch j has the weight
weights[j], and takes row rows[j, c] of the codes by shares[j, c] for each of its eight corners c. The
composite is x = sum_j weights[j] f_j with f_j = sum_c shares[j, c] codes[rows[j, c]]. If the fetches are all
samples of a ray, their weights follow from the density codes q_j, which are interpolated in the same way on a
grid of their own: delta_j = exp(low + slope q_j) lengths[j], T_j = exp(-sum_{i<j} delta_i), weights[j] = T_j
(1 - exp(-delta_j)), A = 1 - exp(-sum delta).

A code is the integer nearest to a `latent`. The integers are composited, but the gradient is applied to the
latents as if there were no rounding (straight-through estimator). Latent densities are float32. Latent
features are int16 in 256ths of a code, because there are so many of them that they decide how fine a grid
fits into memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import prange, types
from numba.extending import overload

from player.compiled.prefetch import prefetch
from vfr_bake.kernels import njit
from vfr_bake.kernels.latent_rows import (
    CHANNELS,
    GOLDEN,
    PARTS,
    PARTS_BITS,
    interpolate_row,
    move_row,
)

BLOCK = 64
"""Rays, or fetches, that a thread takes at a time."""
OWN = 6
"""Each run of 2^OWN vertices belongs to one part (`descend`)."""
AHEAD = 6
"""Number of fetches by which memory is prefetched ahead, because their rows lie all over the grid."""
LINE = 64
"""Bytes in a line of the cache."""


def table(n_rows: int, n_columns: int) -> np.ndarray:
    """Return [n_rows, n_columns] int16, not initialised, which begins at the start of a cache line, so that
    rows of 16 numbers never cross two lines. At least CHANNELS numbers of memory follow it.

    >>> table(3, 16).shape, table(3, 16).ctypes.data % LINE
    ((3, 16), 0)
    """
    n = n_rows * n_columns
    memory = np.empty(n + LINE // 2 + CHANNELS, np.int16)
    first = -memory.ctypes.data % LINE // 2
    return memory[first : first + n].reshape(n_rows, n_columns)


def _shown(value: Any) -> float:
    """Return the number that is composited for a stored value: a latent feature, int16, rounded to a whole
    code, ties upwards; a code or a float as it is.

    >>> [float(_shown(np.int16(parts))) for parts in (127, 128, -128, -129)], _shown(np.int8(7))
    ([0.0, 1.0, 0.0, -1.0], np.int8(7))
    """
    return np.floor(value / PARTS + 0.5) if value.dtype == np.int16 else value


@overload(_shown, strict=False)  # strict compares annotations, too
def _overload_shown(value: types.Type) -> Callable[[Any], Any]:
    if value == types.int16:
        return lambda value: np.float32((value + (PARTS >> 1)) >> PARTS_BITS)
    return lambda value: np.float32(value)


@njit(cache=True)
def _prefetch_rows(rows, j, table, n_columns):
    """Prefetch all cache lines that fetch j will read of `table`, flat. Corners are prefetched in pairs: the
    second of a pair is usually the next row."""
    if j < rows.shape[0]:
        for corner in range(0, 8, 2):
            first = np.int64(rows[j, corner]) * n_columns
            for number in range(first, first + 2 * n_columns, LINE // table.itemsize):
                prefetch(table, number)


@njit(parallel=True, cache=True)
def compose(starts, rows, shares, weights, latent, out):
    """Write the composites of all rays to `out` [n, n_channels], from `latent` [n_vertices, n_channels]:
    latent features, which are rounded, or int8 codes or floats, as they are."""
    n_channels, flat = latent.shape[1], latent.reshape(-1)
    for chunk in prange((out.shape[0] + BLOCK - 1) // BLOCK):
        for i in range(chunk * BLOCK, min((chunk + 1) * BLOCK, out.shape[0])):
            for c in range(n_channels):
                out[i, c] = np.float32(0)
            for j in range(starts[i], starts[i + 1]):
                _prefetch_rows(rows, j + AHEAD, flat, n_channels)
                for corner in range(8):
                    share = weights[j] * shares[j, corner]
                    if share == 0:
                        continue
                    row = rows[j, corner]
                    for c in range(n_channels):
                        out[i, c] += share * _shown(latent[row, c])


def padded(n_channels: int) -> int:
    """Return `n_channels` rounded up to whole registers of CHANNELS numbers.

    >>> [padded(n) // CHANNELS for n in (1, CHANNELS, CHANNELS + 1)]
    [1, 1, 2]
    """
    return -(-n_channels // CHANNELS) * CHANNELS


@njit(parallel=True, cache=True)
def interpolate(rows, shares, weights, latent, out):
    """Write f_j of all fetches to `out` [n_fetches, `padded(n_channels)`], from `latent` features in an array
    made by `table`. Columns beyond n_channels have no meaning; fetches with the weight 0 get 0."""
    for chunk in prange((out.shape[0] + BLOCK - 1) // BLOCK):
        for j in range(chunk * BLOCK, min((chunk + 1) * BLOCK, out.shape[0])):
            _prefetch_rows(rows, j + AHEAD, latent.reshape(-1), latent.shape[1])
            for first in range(0, out.shape[1], CHANNELS):
                if weights[j] == 0:
                    out[j, first : first + CHANNELS] = np.float32(0)
                else:
                    interpolate_row(latent, rows, shares, j, first, out)


@njit(parallel=True, cache=True)
def composite(starts, weights, values, out):
    """Write x of all rays to `out` [n, n_channels], from f_j in `values` [n_fetches, n_channels or more]."""
    for i in prange(out.shape[0]):
        out[i] = np.float32(0)
        for j in range(starts[i], starts[i + 1]):
            for c in range(out.shape[1]):
                out[i, c] += weights[j] * values[j, c]


@njit(cache=True)
def _owner(row, n_parts):
    """Return the part that a vertex belongs to. It is the same for a run of 2^OWN vertices, so that two
    threads hardly ever write to one cache line. It is found by a 32-bit product, because every thread asks
    for every vertex, and a remainder would take several times as long."""
    spread = np.uint32(np.uint32(row >> OWN) * np.uint32(GOLDEN))
    return (np.uint64(spread) * np.uint64(n_parts)) >> np.uint64(32)


@njit(cache=True)
def _prefetch_own(rows, j, part, n_parts, table, numbers):
    """Prefetch what fetch j will read of `table` and `numbers`, in rows that belong to `part`."""
    if j < rows.shape[0]:
        flat, n_columns = table.reshape(-1), table.shape[1]
        for corner in range(8):
            row = rows[j, corner]
            if _owner(row, n_parts) == part:
                prefetch(numbers, row)
                for number in range(row * n_columns, (row + 1) * n_columns, LINE // table.itemsize):
                    prefetch(flat, number)


@njit(cache=True)
def _mixed(step, fetch):
    """Return a pseudo-random number of 32 bits from two others, random enough for the rounding of moves."""
    mixed = np.uint32(step * np.uint32(0x85EBCA6B)) ^ fetch
    mixed = np.uint32((mixed ^ (mixed >> np.uint32(16))) * np.uint32(0x7FEB352D))
    mixed = np.uint32((mixed ^ (mixed >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(mixed ^ (mixed >> np.uint32(16)))


@njit(parallel=True, cache=True)
def descend(starts, rows, shares, weights, gradient, rate, n_parts, latent, steepness, step):
    """Take step number `step` of Adagrad on the latent features, in place; codes stay within -127..127.

    Moves are rounded at random, so that small ones are not lost: 3.25 parts of a code become 4 parts in a
    quarter of all cases, and 3 in the others. The random number follows from the step, the fetch, its corner
    and the channel.

    `latent` is made by `table`; `gradient` [n, `padded(n_channels)`] is that of the composites, 0 beyond
    n_channels. `steepness` [n_vertices] sums up the squared gradients of each vertex, as means over its
    channels, so that vertices that few rays meet move as fast as the others. Each of `n_parts` parts goes
    through all fetches, in their order, and moves only its own vertices, so that the result does not depend
    on the number of parts.
    """
    n_channels = latent.shape[1]
    for part in prange(n_parts):
        for i in range(gradient.shape[0]):
            square = np.float32(0)
            for c in range(n_channels):
                square += gradient[i, c] * gradient[i, c]
            if square == 0:
                continue
            square /= np.float32(n_channels)
            for j in range(starts[i], starts[i + 1]):
                _prefetch_own(rows, j + AHEAD, part, n_parts, latent, steepness)
                for corner in range(8):
                    row = rows[j, corner]
                    share = weights[j] * shares[j, corner]
                    if share == 0 or _owner(row, n_parts) != part:
                        continue
                    steepness[row] += share * share * square
                    if steepness[row] == 0:  # the square of a tiny number underflows to 0
                        continue
                    length = np.float32(PARTS) * rate * share / np.sqrt(steepness[row])
                    random = _mixed(np.uint32(step), np.uint32(8 * j + corner))
                    for first in range(0, n_channels, CHANNELS):
                        move_row(latent, row, first, length, gradient, i, random)


@njit(parallel=True, cache=True)
def weigh(starts, rows, shares, latent, low, slope, lengths, opaque, weights, opacity):
    """Write the weights of all rays' fetches to `weights`, and the rays' opacity to `opacity`, from the
    latent density codes [n_vertices]. Fetches behind the optical depth `opaque` have the weight 0."""
    for chunk in prange((opacity.shape[0] + BLOCK - 1) // BLOCK):
        for i in range(chunk * BLOCK, min((chunk + 1) * BLOCK, opacity.shape[0])):
            tau = np.float32(0)
            for j in range(starts[i], starts[i + 1]):
                if tau > opaque:
                    weights[j] = np.float32(0)
                    continue
                _prefetch_rows(rows, j + AHEAD, latent, 1)
                code = np.float32(0)
                for corner in range(8):
                    code += shares[j, corner] * np.rint(latent[rows[j, corner]])
                delta = np.exp(low + slope * code) * lengths[j]
                weights[j] = -np.exp(-tau) * np.expm1(-delta)
                tau += delta
            opacity[i] = -np.expm1(-tau)


# With these flags, sums over channels may be in any order, which makes it a quarter faster.
@njit(parallel=True, cache=True, fastmath={"reassoc", "nsz", "contract"})
def slants(
    starts, density_rows, density_shares, weights, opacity, values, gradient, gradient_of_opacity, low, slope,
    lengths, latent, out,
):  # fmt: skip
    """Write the gradient with respect to each fetch's interpolated density code to `out` [n_fetches].

    dx / d delta_j = T_{j+1} f_j - sum_{i>j} weights[i] f_i, and dA / d delta_j = 1 - A. `values`
    [n_fetches, `padded(n_channels)`] are the f_j that `interpolate` writes. `gradient`, with as many columns,
    and `gradient_of_opacity` [n] are the gradients of x and A. `latent` [n_densities] are the latent density
    codes.
    """
    for chunk in prange((gradient.shape[0] + BLOCK - 1) // BLOCK):
        for i in range(chunk * BLOCK, min((chunk + 1) * BLOCK, gradient.shape[0])):
            behind = np.float32(0)
            for j in range(starts[i], starts[i + 1]):
                _prefetch_rows(density_rows, j + AHEAD, latent, 1)
                along = np.float32(0)
                for first in range(0, values.shape[1], CHANNELS):
                    for c in range(CHANNELS):
                        along += gradient[i, first + c] * values[j, first + c]
                out[j] = along
                behind += weights[j] * along
            trans = np.float32(1)
            left = np.float32(1) - opacity[i]
            for j in range(starts[i], starts[i + 1]):
                weight, along = weights[j], out[j]
                if weight == 0:
                    out[j] = np.float32(0)
                    continue
                code = np.float32(0)
                for corner in range(8):
                    code += density_shares[j, corner] * np.rint(latent[density_rows[j, corner]])
                delta = np.exp(low + slope * code) * lengths[j]
                behind -= weight * along
                trans -= weight
                out[j] = (trans * along - behind + left * gradient_of_opacity[i]) * delta * slope


@njit(parallel=True, cache=True)
def descend_density(rows, shares, slants, rate, n_parts, latent, steepness):
    """Take one step of Adagrad on the latent density codes [n_densities], in place; codes stay within 0..255.
    `slants` [n_fetches] are the gradients of the codes that are interpolated from `rows` by `shares`. The
    vertices are split into parts as in `descend`."""
    for part in prange(n_parts):
        for j in range(slants.shape[0]):
            _prefetch_rows(rows, j + AHEAD, latent, 1)
            _prefetch_rows(rows, j + AHEAD, steepness, 1)
            if slants[j] == 0:
                continue
            for corner in range(8):
                row = rows[j, corner]
                slant = shares[j, corner] * slants[j]
                if slant == 0 or _owner(row, n_parts) != part:
                    continue
                steepness[row] += slant * slant
                if steepness[row] == 0:  # the square of a tiny number underflows to 0
                    continue
                moved = latent[row] - rate * slant / np.sqrt(steepness[row])
                latent[row] = min(max(moved, np.float32(0)), np.float32(255))


@njit(parallel=True, cache=True)
def corner_rows(points, resolution, n_per_axis, bricks, of_bricks, least, rows, shares):
    """Find the stored corners around `points` [n, 3] float32 of a grid, in cells, as `player.march.fetches`
    states. Write `rows` [n, 8], and trilinear `shares` [n, 8], which are 0 where a corner is not stored.

    If `least` is above 0, shares are divided by their sum, and all 0 where that sum is below `least`.
    """
    size = np.float32(resolution)
    one = np.float32(1)
    last = resolution - 1
    for i in prange(points.shape[0]):
        gx = min(max(points[i, 0], np.float32(0)), size)
        gy = min(max(points[i, 1], np.float32(0)), size)
        gz = min(max(points[i, 2], np.float32(0)), size)
        x, y, z = min(int(gx), last), min(int(gy), last), min(int(gz), last)
        total = np.float32(0)
        brick = np.int64(bricks[((x >> 3) * n_per_axis + (y >> 3)) * n_per_axis + (z >> 3)])
        level = max(brick, 0) & 7
        x, y, z = x >> level, y >> level, z >> level
        width = one / np.float32(1 << level)
        fx, fy, fz = gx * width - np.float32(x), gy * width - np.float32(y), gz * width - np.float32(z)
        first = (brick >> 3) * 729 + (x & 7) * 81 + (y & 7) * 9 + (z & 7)
        for corner in range(8):
            ix, iy, iz = corner >> 2, (corner >> 1) & 1, corner & 1
            row = of_bricks[first + ix * 81 + iy * 9 + iz] if brick >= 0 else -1
            rows[i, corner] = max(row, 0)
            shares[i, corner] = np.float32(0)
            if row >= 0:
                shares[i, corner] = (
                    (fx if ix else one - fx) * (fy if iy else one - fy) * (fz if iz else one - fz)
                )
            total += shares[i, corner]
        if least > 0:
            scale = one / total if total >= least else np.float32(0)
            for corner in range(8):
                shares[i, corner] *= scale


@njit(parallel=True, cache=True)
def take_runs(rays, starts, points, lengths, taken_starts, taken_points, taken_lengths):
    """Copy the run starts[ray] to starts[ray + 1] of `points` [m, 3] and `lengths` [m], for the i-th of the
    `rays` [n], to `taken_points` and `taken_lengths` from taken_starts[i] on."""
    for i in prange(len(rays)):
        first, to = starts[rays[i]], taken_starts[i]
        for j in range(starts[rays[i] + 1] - first):
            taken_lengths[to + j] = lengths[first + j]
            for axis in range(3):
                taken_points[to + j, axis] = points[first + j, axis]
