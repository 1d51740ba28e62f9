"""The march of `player.march`, compiled by numba: the same semantics, one ray after the other.

Every function has its readable twin in `player.march`, whose docstring states the mathematics; the tests
compare the two. Arithmetic that decides which cell a sample falls into is float32 in the same order in both.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from player.few_samples import MIN_TOTAL
from player.march import MAX_TAU, MIN_OPACITY, SKIP_MARGIN, MarchResult
from player.sparse_grid import ABSENT, SparseGrid

try:
    import numba

    from player.eight_rows import LANES, add_rows
except ImportError:  # an extra: without it `player.march` runs
    numba = None

F32 = np.float32


def available() -> bool:
    """Whether numba is installed."""
    return numba is not None


def compiled(function: Callable[..., Any], inline: bool = False) -> Callable[..., Any]:
    """A function compiled by numba where that is installed; it runs without the interpreter's lock and may
    not allocate.

    Without counted references: the threads would count the grid's arrays in turns, millions of times a
    picture.
    """
    if numba is None:
        return function
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False, "forceinline": inline}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to keep the compiled code in: compile again in every process
        return numba.njit(**options)(function)


def _jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """A part of a compiled function, inlined: a call would pass 60 words."""
    return compiled(function, inline=True)


def march(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    n_samples: int,
    bounds: tuple[np.ndarray, np.ndarray] | None = None,
) -> MarchResult:
    """`player.march.march`, compiled: same arguments, same result to float32 rounding."""
    n_rays = len(rays_o)
    near = np.zeros(n_rays, F32) if bounds is None else bounds[0]
    far = np.full(n_rays, np.inf, F32) if bounds is None else bounds[1]
    opacity, depth = np.zeros(n_rays, F32), np.zeros(n_rays, F32)
    counts, hits = np.zeros(n_rays, np.int32), np.empty(n_rays, np.int64)
    features = np.zeros((n_rays, grid.n_channels), F32)
    capacity = grid.most_samples
    origin, scale = tuple(grid.aabb_min), tuple(grid.cells_per_unit)
    n_hits = _march_rays(
        (grid.resolution, grid.n_per_axis, grid.step, grid.density_low, grid.density_slope, origin, scale),
        (grid.table, grid.live, grid.density),
        (grid.bricks, grid.base, grid.ranks, grid.features),
        (np.ascontiguousarray(rays_o, F32), np.ascontiguousarray(rays_d, F32), near, far),
        n_samples,
        (np.empty(capacity, F32), np.empty(capacity, F32), np.empty(8, np.int64), np.empty(8, F32),
         np.zeros((1, -(-grid.n_channels // LANES) * LANES), F32)),
        (opacity, depth, counts, features, hits),
    )  # fmt: skip
    return MarchResult(opacity, depth, counts, hits[:n_hits], features[:n_hits])


@compiled
def _march_rays(settings, lookup, stored, rays, k, scratch, out):
    """Every ray: its samples into the scratch arrays, then its fetches into the next row of `features`."""
    resolution, n_per_axis, step, low, slope, origin, scale = settings
    rays_o, rays_d, near, far = rays
    scratch_s, scratch_w, corner_rows, corner_shares, one_row = scratch
    opacity, depth, counts, features, hits = out
    n_hits = 0
    for ray in range(len(near)):
        dx, dy, dz = rays_d[ray, 0] * scale[0], rays_d[ray, 1] * scale[1], rays_d[ray, 2] * scale[2]
        ox = (rays_o[ray, 0] - origin[0]) * scale[0]
        oy = (rays_o[ray, 1] - origin[1]) * scale[1]
        oz = (rays_o[ray, 2] - origin[2]) * scale[2]
        size = F32(resolution)
        t_in, t_out = _slab(ox, dx, size, F32(0.0), F32(np.inf))
        t_in, t_out = _slab(oy, dy, size, t_in, t_out)
        t_in, t_out = _slab(oz, dz, size, t_in, t_out)
        longest = F32(len(scratch_s) - 1) * step  # the scratch holds no more, whatever the ray
        length = min(min(t_out - t_in, longest), far[ray] - t_in)
        if not length > F32(0.0):
            continue
        first = math.floor(max(near[ray] - t_in, F32(0.0)) / step - F32(0.5))
        point = (
            min(max(ox + t_in * dx, F32(0.0)), size),
            min(max(oy + t_in * dy, F32(0.0)), size),
            min(max(oz + t_in * dz, F32(0.0)), size),
        )
        n, taken, tau, total, moment = _collect(
            (resolution, n_per_axis, step, low, slope), lookup, point, (dx, dy, dz), max(first, 0), length,
            scratch_s, scratch_w,
        )  # fmt: skip
        counts[ray] = taken
        if n == 0:
            continue
        mass = F32(_opacity(tau))
        opacity[ray] = mass
        depth[ray] = t_in + F32(moment / total)
        if mass > MIN_OPACITY:
            one_row[:] = F32(0.0)
            _gather(
                stored, (resolution, n_per_axis), point, (dx, dy, dz), scratch_s, scratch_w, n, total, mass,
                k, corner_rows, corner_shares, one_row, 0,
            )  # fmt: skip
            for c in range(features.shape[1]):
                features[n_hits, c] = one_row[0, c]
            hits[n_hits] = ray
            n_hits += 1
    return n_hits


@_jit
def _slab(o, d, size, t_in, t_out):
    """Narrow the interval of t to one slab of the box; empty (t_out = -inf) for a parallel ray outside it."""
    if d == F32(0.0):
        if o < F32(0.0) or o > size:
            return t_in, F32(-np.inf)
        return t_in, t_out
    a = (F32(0.0) - o) / d
    b = (size - o) / d
    return max(t_in, min(a, b)), min(t_out, max(a, b))


@_jit
def _opacity(tau):
    """1 - exp(-tau) to float32 rounding: the difference in float64, or the series where that would cancel."""
    if tau < F32(1e-5):
        return tau - F32(0.5) * tau * tau
    return F32(1.0 - math.exp(-np.float64(tau)))


@_jit
def _collect(settings, lookup, point, direction, first, length, scratch_s, scratch_w):
    """March one ray: s and weight of each sample that has weight into the scratch arrays.

    Returns how many, the number of samples taken, tau, and the sums of w and of w s.
    """
    resolution, n_per_axis, step, low, slope = settings
    table, live, density = lookup
    ex, ey, ez = point
    dx, dy, dz = direction
    last = resolution - 1
    per_step = F32(1.0) / step
    inverse = _inverse(dx), _inverse(dy), _inverse(dz)
    tau = F32(0.0)
    trans = F32(1.0)
    total = 0.0
    moment = 0.0
    n = 0
    taken = 0
    i = first
    while True:
        s = (F32(i) + F32(0.5)) * step
        if s >= length:
            break
        gx, gy, gz = ex + s * dx, ey + s * dy, ez + s * dz
        x, y, z = min(max(int(gx), 0), last), min(max(int(gy), 0), last), min(max(int(gz), 0), last)
        slot = table[((x >> 3) * n_per_axis + (y >> 3)) * n_per_axis + (z >> 3)]
        if slot < 0:
            reach = -1 - slot
            leave = min(
                _leave(ex, inverse[0], x >> 3, reach),
                min(_leave(ey, inverse[1], y >> 3, reach), _leave(ez, inverse[2], z >> 3, reach)),
            )
            i = max(i + 1, int(min(leave, length) * per_step + F32(0.5)))
            continue
        i += 1
        lx, ly, lz = x & 7, y & 7, z & 7
        if (live[slot * 64 + lx * 8 + ly] >> lz) & 1 == 0:
            continue
        code = _trilinear(density, slot * 729 + lx * 81 + ly * 9 + lz, gx - F32(x), gy - F32(y), gz - F32(z))
        optical = math.exp(low + slope * code) * step
        taken += 1
        tau += optical
        behind = math.exp(-tau)
        # alpha = -expm1(-optical), without its cost: a difference where it does not cancel, else four terms
        if optical > F32(0.1):
            weight = trans - behind
        else:
            weight = (
                trans
                * optical
                * (F32(1) - optical * (F32(1 / 2) - optical * (F32(1 / 6) - optical * F32(1 / 24))))
            )
        trans = behind
        if weight > F32(0.0):
            scratch_s[n] = s
            scratch_w[n] = weight
            n += 1
            total += weight
            moment += np.float64(weight) * s
        if tau > MAX_TAU:
            break
    return n, taken, tau, total, moment


@_jit
def _inverse(d):
    """1 / d, infinite for a ray that stays where it is along this axis."""
    return F32(1.0) / d if d != F32(0.0) else F32(np.inf)


@_jit
def _leave(e, inverse, brick, reach):
    """s at which a ray leaves the bricks within `reach` of `brick` along one axis, a margin early; `inverse`
    is one over its direction there."""
    if math.isinf(inverse):
        return F32(np.inf)
    if inverse > F32(0.0):
        return (F32((brick + reach + 1) * 8) - SKIP_MARGIN - e) * inverse
    return (F32((brick - reach) * 8) + SKIP_MARGIN - e) * inverse


@_jit
def _trilinear(density, at, fx, fy, fz):
    """Codes between the corners of a cell: along z, then y, then x."""
    c000, c001 = F32(density[at]), F32(density[at + 1])
    c010, c011 = F32(density[at + 9]), F32(density[at + 10])
    c100, c101 = F32(density[at + 81]), F32(density[at + 82])
    c110, c111 = F32(density[at + 90]), F32(density[at + 91])
    c00, c01 = c000 + (c001 - c000) * fz, c010 + (c011 - c010) * fz
    c10, c11 = c100 + (c101 - c100) * fz, c110 + (c111 - c110) * fz
    c0, c1 = c00 + (c01 - c00) * fy, c10 + (c11 - c10) * fy
    return c0 + (c1 - c0) * fx


@_jit
def _gather(stored, sizes, point, direction, scratch_s, scratch_w, n, total, mass, k, rows, shares, out, row):
    """Choose the fetches of one ray and add them up in `out[row]`: bins of equal mass, filled in one pass."""
    if k == 0 or n <= k:
        for i in range(n):
            _fetch(stored, sizes, point, direction, scratch_s[i], scratch_w[i], rows, shares, out, row)
        return
    share = total / k
    weight = mass / F32(k)
    i = 0
    left = np.float64(scratch_w[0])
    for _ in range(k):
        need = share
        moment = 0.0
        heaviest = -1.0
        heaviest_s = scratch_s[i]
        while True:
            part = min(left, need)
            moment += part * scratch_s[i]
            if part > heaviest:
                heaviest = part
                heaviest_s = scratch_s[i]
            need -= part
            left -= part
            if left > 0.0 or i == n - 1:
                break
            i += 1
            left = np.float64(scratch_w[i])
            if need <= 0.0:
                break
        s = F32(moment / share)
        if not _fetch(stored, sizes, point, direction, s, weight, rows, shares, out, row):
            _fetch(stored, sizes, point, direction, heaviest_s, weight, rows, shares, out, row)


@_jit
def _fetch(stored, sizes, point, direction, s, weight, rows, shares, out, row):
    """Add `weight` times the features at s to `out[row]`; False, and nothing added, where too little is
    stored."""
    resolution, n_per_axis = sizes
    bricks, base, ranks, features = stored
    size = F32(resolution)
    gx = min(max(point[0] + s * direction[0], F32(0.0)), size)
    gy = min(max(point[1] + s * direction[1], F32(0.0)), size)
    gz = min(max(point[2] + s * direction[2], F32(0.0)), size)
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
    _add(features, rows, shares, weight / total, out, row)
    return True


@_jit
def _bit(x, y, z):
    return (x & 7) * 64 + (y & 7) * 8 + (z & 7)


@_jit
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


@_jit
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


@_jit
def _share(fraction, ix, iy, iz):
    fx, fy, fz = fraction
    return (fx if ix else F32(1.0) - fx) * (fy if iy else F32(1.0) - fy) * (fz if iz else F32(1.0) - fz)


@_jit
def _add(features, rows, shares, scale, out, row):
    """Add `scale` times the weighted rows to `out[row]`, in registers where there is room to read and write
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
            add_rows(features, eight, parts, out, row, first)
        return
    for corner in range(8):
        for c in range(n_channels):
            out[row, c] += shares[corner] * scale * features[rows[corner], c]
