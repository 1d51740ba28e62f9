"""Reading a sparse grid in compiled code: densities at samples, fetches of features.

Every function has its readable twin in `player.march` or `player.few_samples`.
"""

from __future__ import annotations

import math

import numpy as np

from player.compiling import inlined
from player.few_samples import MIN_TOTAL
from player.vertex_rows import ABSENT

try:
    from player.eight_rows import LANES, add_rows
except ImportError:  # without numba nothing here runs compiled, and nobody calls it
    LANES = 1

F32 = np.float32


@inlined
def opacity_of(tau):
    """1 - exp(-tau) to float32 rounding: the difference in float64, or the series where that would cancel."""
    if tau < F32(1e-5):
        return tau - F32(0.5) * tau * tau
    return F32(1.0 - math.exp(-np.float64(tau)))


@inlined
def weight_of(optical, trans, behind):
    """trans (1 - exp(-optical)) without the cost of expm1: where that does not cancel the difference to
    `behind`, which is trans exp(-optical), else four terms."""
    if optical > F32(0.1):
        return trans - behind
    series = F32(1) - optical * (F32(1 / 2) - optical * (F32(1 / 6) - optical * F32(1 / 24)))
    return trans * optical * series


@inlined
def trilinear(density, at, fx, fy, fz):
    """Codes between the corners of a cell: along z, then y, then x."""
    c000, c001 = F32(density[at]), F32(density[at + 1])
    c010, c011 = F32(density[at + 9]), F32(density[at + 10])
    c100, c101 = F32(density[at + 81]), F32(density[at + 82])
    c110, c111 = F32(density[at + 90]), F32(density[at + 91])
    c00, c01 = c000 + (c001 - c000) * fz, c010 + (c011 - c010) * fz
    c10, c11 = c100 + (c101 - c100) * fz, c110 + (c111 - c110) * fz
    c0, c1 = c00 + (c01 - c00) * fy, c10 + (c11 - c10) * fy
    return c0 + (c1 - c0) * fx


@inlined
def equal_mass(scratch_s, scratch_w, n, total, k, places):
    """Cut the n samples of a ray into k bins of equal mass, in one pass (`player.few_samples`).

    Into `places` [2, >= k]: s of each bin's centroid, and of its heaviest sample.
    """
    share = total / k
    i = 0
    left = np.float64(scratch_w[0])
    for bin_ in range(k):
        need = share
        moment = 0.0
        heaviest = -1.0
        places[1, bin_] = scratch_s[i]
        while True:
            part = min(left, need)
            moment += part * scratch_s[i]
            if part > heaviest:
                heaviest = part
                places[1, bin_] = scratch_s[i]
            need -= part
            left -= part
            if left > 0.0 or i == n - 1:
                break
            i += 1
            left = np.float64(scratch_w[i])
            if need <= 0.0:
                break
        places[0, bin_] = F32(moment / share)


@inlined
def fetch(stored, sizes, point, direction, s, weight, corners, out):
    """Add `weight` times the features at s to `out`; False, and nothing added, where too little is
    stored."""
    resolution, n_per_axis, scale = sizes
    bricks, base, ranks, features = stored
    rows, shares = corners
    size = F32(resolution)
    gx = min(max((point[0] + s * direction[0]) * scale, F32(0.0)), size)
    gy = min(max((point[1] + s * direction[1]) * scale, F32(0.0)), size)
    gz = min(max((point[2] + s * direction[2]) * scale, F32(0.0)), size)
    last = resolution - 1
    x, y, z = min(int(gx), last), min(int(gy), last), min(int(gz), last)
    fx, fy, fz = gx - F32(x), gy - F32(y), gz - F32(z)
    held = np.int64(bricks[((x >> 3) * n_per_axis + (y >> 3)) * n_per_axis + (z >> 3)])
    if max(x & 7, max(y & 7, z & 7)) < 7 and held >= 0:
        total = _corners_of_brick(base[held], ranks, held * 512 + _bit(x, y, z), (fx, fy, fz), rows, shares)
    else:
        total = _corners(stored, n_per_axis, (x, y, z), (fx, fy, fz), rows, shares)
    if total < MIN_TOTAL:
        return False
    _add(features, rows, shares, weight / total, out)
    return True


@inlined
def _bit(x, y, z):
    return (x & 7) * 64 + (y & 7) * 8 + (z & 7)


@inlined
def _corners_of_brick(first, ranks, at, fraction, rows, shares):
    """Rows and interpolation weights of the corners of a cell within one brick; returns the weights' sum.

    Of what is not stored the weight is 0.
    """
    total = F32(0.0)
    for corner in range(8):
        ix, iy, iz = corner >> 2, (corner >> 1) & 1, corner & 1
        rank = np.int64(ranks[at + (ix * 64 + iy * 8 + iz)])
        rows[corner] = first + rank if rank != ABSENT else 0
        shares[corner] = _share(fraction, ix, iy, iz) if rank != ABSENT else F32(0.0)
        total += shares[corner]
    return total


@inlined
def _corners(stored, n_per_axis, cell, fraction, rows, shares):
    """`_corners_of_brick` for a cell whose corners lie in several bricks."""
    bricks, base, ranks, _ = stored
    total = F32(0.0)
    for corner in range(8):
        ix, iy, iz = corner >> 2, (corner >> 1) & 1, corner & 1
        vx, vy, vz = cell[0] + ix, cell[1] + iy, cell[2] + iz
        brick = np.int64(bricks[((vx >> 3) * n_per_axis + (vy >> 3)) * n_per_axis + (vz >> 3)])
        rows[corner] = 0
        shares[corner] = F32(0.0)
        if brick >= 0:
            rank = np.int64(ranks[brick * 512 + _bit(vx, vy, vz)])
            if rank != ABSENT:
                rows[corner] = base[brick] + rank
                shares[corner] = _share(fraction, ix, iy, iz)
                total += shares[corner]
    return total


@inlined
def _share(fraction, ix, iy, iz):
    fx, fy, fz = fraction
    return (fx if ix else F32(1.0) - fx) * (fy if iy else F32(1.0) - fy) * (fz if iz else F32(1.0) - fz)


@inlined
def _add(features, rows, shares, scale, out):
    """Add `scale` times the weighted rows to `out`, in registers where there is room to read and write
    them whole."""
    n_channels = features.shape[1]
    wide = out.shape[1] // LANES * LANES
    last = max(
        max(max(rows[0], rows[1]), max(rows[2], rows[3])), max(max(rows[4], rows[5]), max(rows[6], rows[7]))
    )
    if n_channels <= wide and last * n_channels + wide <= features.size:
        eight = (rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rows[7])
        parts = (
            shares[0] * scale, shares[1] * scale, shares[2] * scale, shares[3] * scale,
            shares[4] * scale, shares[5] * scale, shares[6] * scale, shares[7] * scale,
        )  # fmt: skip
        for first in range(0, n_channels, LANES):
            add_rows(features, eight, parts, out, first)
        return
    for corner in range(8):
        for c in range(n_channels):
            out[0, c] += shares[corner] * scale * features[rows[corner], c]
