"""March of rays through the occupancy grid. The field's density is evaluated on the way, so that a ray stops
where it is opaque.

Letters: the model frame's box is `aabb` = [-1, 1]^3, u = (x + 1) / 2 its unit cube. Samples of a ray lie at
t_i = t_near + (i + jitter) * step; `distance` [n, n, n] is the Chebyshev distance in cells to the nearest
occupied cell (0: occupied), so that d - 1 whole cells around an empty one can be skipped.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from vfr_bake.kernels import njit
from vfr_bake.kernels.density import look_up
from vfr_bake.kernels.hash_grid import FLAGS, cell_of


@njit(inline="always")
def ray_box(rays_o, rays_d, ray):
    """Return entry and exit of a ray in [-1, 1]^3, entry at least 0; entry >= exit if the ray misses."""
    kind = rays_o.dtype.type
    t_near, t_far = kind(0), kind(1e30)
    for axis in range(3):
        o, d = rays_o[ray, axis], rays_d[ray, axis]
        if d == 0:
            if o < -1 or o > 1:
                t_far = kind(-1)
            continue
        a, b = (kind(-1) - o) / d, (kind(1) - o) / d
        t_near = max(t_near, min(a, b))
        t_far = min(t_far, max(a, b))
    return t_near, t_far


@njit(inline="always")
def _empty_length(ux, uy, uz, rays_d, ray, distance, n):
    """Return a path length that is certainly empty from a point of the unit cube on; 0 in an occupied
    cell."""
    kind = rays_d.dtype.type
    cells, last = kind(n), np.int32(n - 1)
    ix, iy, iz = cell_of(ux * cells, last), cell_of(uy * cells, last), cell_of(uz * cells, last)
    d = np.int64(distance[ix, iy, iz])
    if d == 0:
        return kind(0)
    leave = kind(1e30)
    for axis in range(3):
        u, i = (ux, ix) if axis == 0 else ((uy, iy) if axis == 1 else (uz, iz))
        v = rays_d[ray, axis] * kind(0.5)
        if v > 0:
            leave = min(leave, (kind(i + d) / cells - u) / v)
        elif v < 0:
            leave = min(leave, (kind(i - d + 1) / cells - u) / v)
    return max(leave, kind(1e-12))


@njit(fastmath=FLAGS, error_model="numpy")
def next_sample(rays_o, rays_d, ray, t_near, t_far, i, jitter, step, distance):
    """Return (number, t, ux, uy, uz) of the first lattice sample, from number `i` on, that lies in an
    occupied cell. The number is -1 past the exit.

    Skips land on or before the cell border that they aim at, so that no sample in an occupied cell is
    skipped.
    """
    kind = rays_o.dtype.type
    half = kind(0.5)
    n = distance.shape[0]
    while True:
        t = t_near + (kind(i) + jitter) * step
        ux = (rays_o[ray, 0] + t * rays_d[ray, 0]) * half + half
        uy = (rays_o[ray, 1] + t * rays_d[ray, 1]) * half + half
        uz = (rays_o[ray, 2] + t * rays_d[ray, 2]) * half + half
        if not t < t_far:
            return -1, t, ux, uy, uz
        empty = _empty_length(ux, uy, uz, rays_d, ray, distance, n)
        if empty == 0:
            return i, t, ux, uy, uz
        i += max(np.int64(empty / step), 1)


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def march_samples(
    rays_o, rays_d, jitter, step, distance, field, limits, counts, starts, t_mid, points, features, sigmas
):  # fmt: skip
    """Write the visible samples of as many rays as fit, in one pass that counts them as it writes them.
    Return the number of samples of each chunk.

    `t_mid` and `sigmas` [n_chunks, capacity], `points` [n_chunks, capacity, 3] and `features`
    [n_chunks, capacity, n_channels] receive the samples; chunk c serves the rays c, c + n_chunks, ... A ray
    is begun only if the most samples that it could have, ceil((t_far - t_near) / step) + 1, still fit, so
    that nothing is ever written past the end. `counts` [n_rays] is -1 for rays that were not served. `starts`
    [n_rays] is the first sample of each ray within its chunk.
    """
    kind = rays_o.dtype.type
    n_chunks, capacity = t_mid.shape
    n_rays = rays_o.shape[0]
    used = np.zeros(n_chunks, np.int64)
    for chunk in prange(n_chunks):
        hidden = np.zeros(field.b1.shape[0], rays_o.dtype)
        k = 0
        for ray in range(chunk, n_rays, n_chunks):
            counts[ray] = -1
        for ray in range(chunk, n_rays, n_chunks):
            t_near, t_far = ray_box(rays_o, rays_d, ray)
            if t_near >= t_far:
                counts[ray] = 0
                starts[ray] = k
                continue
            if k + np.int64((t_far - t_near) / step) + 2 > capacity:
                break
            starts[ray] = k
            tau = kind(0)
            i = np.int64(0)
            while tau <= limits.opaque_depth:
                i, t, ux, uy, uz = next_sample(
                    rays_o, rays_d, ray, t_near, t_far, i, jitter[ray], step, distance
                )
                if i < 0:
                    break
                sigma = look_up(ux, uy, uz, field, limits, features[chunk, k], hidden)
                t_mid[chunk, k] = t
                points[chunk, k, 0], points[chunk, k, 1], points[chunk, k, 2] = ux, uy, uz
                sigmas[chunk, k] = sigma
                k += 1
                i += 1
                tau += sigma * step
            counts[ray] = k - starts[ray]
        used[chunk] = k
    return used


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def render_features(rays_o, rays_d, step, distance, field, limits, out, opacity):
    """Composite features along rays without storing samples: add them to `out` [n_rays, n_channels], which
    must be 0 before, and write `opacity` [n_rays]."""
    kind = rays_o.dtype.type
    half = kind(0.5)
    block = 64
    n_rays = rays_o.shape[0]
    for start in prange((n_rays + block - 1) // block):
        hidden = np.zeros(field.b1.shape[0], rays_o.dtype)
        feature = np.zeros(out.shape[1], rays_o.dtype)
        for ray in range(start * block, min((start + 1) * block, n_rays)):
            t_near, t_far = ray_box(rays_o, rays_d, ray)
            tau = kind(0)
            trans = kind(1)
            i = np.int64(0)
            while tau <= limits.opaque_depth:
                i, _, ux, uy, uz = next_sample(rays_o, rays_d, ray, t_near, t_far, i, half, step, distance)
                if i < 0:
                    break
                i += 1
                delta = look_up(ux, uy, uz, field, limits, feature, hidden) * step
                weight = -trans * np.expm1(-delta)
                for c in range(out.shape[1]):
                    out[ray, c] += weight * feature[c]
                tau += delta
                trans = np.exp(-tau)
            opacity[ray] = -np.expm1(-tau)


@njit(cache=True)
def chebyshev_distance(occupied, distance):
    """Write to `distance` [n, n, n] uint8 the Chebyshev distance, in cells and at most 254, to the nearest
    cell that is `occupied` [n, n, n] bool. Outside the grid nothing is occupied.

    There are two sweeps, each over half of the 26 neighbours. For a row of cells, the neighbours in the rows
    swept before come first, in a loop that vectorises, and then the neighbour along z.
    """
    n = occupied.shape[0]
    # a frame of the largest distance around the grid, so that no neighbour needs a test for the border
    d = np.full((n + 2, n + 2, n + 2), 254, np.uint8)
    one, far = np.uint8(1), np.uint8(253)  # 253 + 1 still fits
    for x in range(n):
        for y in range(n):
            for z in range(n):
                if occupied[x, y, z]:
                    d[x + 1, y + 1, z + 1] = 0
    for sweep in range(2):
        sign = 1 - 2 * sweep
        for i in range(n):
            x = 1 + i if sweep == 0 else n - i
            before = x - sign
            for j in range(n):
                y = 1 + j if sweep == 0 else n - j
                for z in range(1, n + 1):
                    best = d[x, y - sign, z - 1]
                    best = min(best, d[x, y - sign, z])
                    best = min(best, d[x, y - sign, z + 1])
                    for dy in range(-1, 2):
                        best = min(best, d[before, y + dy, z - 1])
                        best = min(best, d[before, y + dy, z])
                        best = min(best, d[before, y + dy, z + 1])
                    d[x, y, z] = min(d[x, y, z], min(best, far) + one)
                for k in range(n):
                    z = 1 + k if sweep == 0 else n - k
                    d[x, y, z] = min(d[x, y, z], min(d[x, y, z - sign], far) + one)
    for x in range(n):
        for y in range(n):
            for z in range(n):
                distance[x, y, z] = d[x + 1, y + 1, z + 1]
