"""The march of `player.march`, compiled by numba: the same semantics, one ray after the other.

Every function has its readable twin in `player.march`, whose docstring states the mathematics; the tests
compare the two. Arithmetic that decides which cell a sample falls into is float32 in the same order in both.
"""

from __future__ import annotations

import math

import numpy as np

from player.compiling import compiled, inlined
from player.grid_compiled import LANES, equal_mass, fetch, opacity_of, trilinear, weight_of
from player.march import MAX_TAU, MIN_OPACITY, SKIP_MARGIN, MarchResult
from player.sparse_grid import SparseGrid

F32 = np.float32


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
        (grid.rows.bricks, grid.rows.base, grid.rows.ranks, grid.features),
        (grid.rows.resolution, grid.rows.n_per_axis, grid.feature_scale),
        (np.ascontiguousarray(rays_o, F32), np.ascontiguousarray(rays_d, F32), near, far),
        n_samples,
        (np.empty(capacity, F32), np.empty(capacity, F32), np.empty((2, max(n_samples, 1)), F32)),
        (np.empty(8, np.int64), np.empty(8, F32)),
        np.zeros((1, -(-grid.n_channels // LANES) * LANES), F32),
        (opacity, depth, counts, features, hits),
    )  # fmt: skip
    return MarchResult(opacity, depth, counts, hits[:n_hits], features[:n_hits])


@compiled
def _march_rays(settings, lookup, stored, sizes, rays, k, scratch, corners, composite, out):
    """Every ray: its samples into the scratch arrays, then its fetches into the next row of `features`."""
    resolution, n_per_axis, step, low, slope, origin, scale = settings
    rays_o, rays_d, near, far = rays
    scratch_s, scratch_w, _ = scratch
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
        mass = F32(opacity_of(tau))
        opacity[ray] = mass
        depth[ray] = t_in + F32(moment / total)
        if mass > MIN_OPACITY:
            composite[:] = F32(0.0)
            _gather(
                stored, sizes, point, (dx, dy, dz), scratch, n, total, mass, k, corners,
                composite,
            )  # fmt: skip
            for c in range(features.shape[1]):
                features[n_hits, c] = composite[0, c]
            hits[n_hits] = ray
            n_hits += 1
    return n_hits


@inlined
def _slab(o, d, size, t_in, t_out):
    """Narrow the interval of t to one slab of the box; empty (t_out = -inf) for a parallel ray outside it."""
    if d == F32(0.0):
        if o < F32(0.0) or o > size:
            return t_in, F32(-np.inf)
        return t_in, t_out
    a = (F32(0.0) - o) / d
    b = (size - o) / d
    return max(t_in, min(a, b)), min(t_out, max(a, b))


@inlined
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
        code = trilinear(density, slot * 729 + lx * 81 + ly * 9 + lz, gx - F32(x), gy - F32(y), gz - F32(z))
        optical = math.exp(low + slope * code) * step
        taken += 1
        tau += optical
        behind = math.exp(-tau)
        weight = weight_of(optical, trans, behind)
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


@inlined
def _inverse(d):
    """1 / d, infinite for a ray that stays where it is along this axis."""
    return F32(1.0) / d if d != F32(0.0) else F32(np.inf)


@inlined
def _leave(e, inverse, brick, reach):
    """s at which a ray leaves the bricks within `reach` of `brick` along one axis, a margin early; `inverse`
    is one over its direction there."""
    if math.isinf(inverse):
        return F32(np.inf)
    if inverse > F32(0.0):
        return (F32((brick + reach + 1) * 8) - SKIP_MARGIN - e) * inverse
    return (F32((brick - reach) * 8) + SKIP_MARGIN - e) * inverse


@inlined
def _gather(stored, sizes, point, direction, samples, n, total, mass, k, corners, out):
    """Choose the fetches of one ray and add them up in `out`."""
    scratch_s, scratch_w, places = samples
    if k == 0 or n <= k:
        for i in range(n):
            fetch(stored, sizes, point, direction, scratch_s[i], scratch_w[i], corners, out)
        return
    equal_mass(scratch_s, scratch_w, n, total, k, places)
    weight = mass / F32(k)
    for i in range(k):
        if not fetch(stored, sizes, point, direction, places[0, i], weight, corners, out):
            fetch(stored, sizes, point, direction, places[1, i], weight, corners, out)
