"""The march of `player.contracted_march`, compiled by numba: the same semantics, one ray after the other.

Its readable twin states the mathematics; the tests compare the two. Arithmetic that decides which cell a
sample falls into is float32 in the same order in both.
"""

from __future__ import annotations

import math

import numpy as np

from player.compiling import compiled, inlined
from player.contracted_rays import MAX_SPEED, MIN_COS, SPARE, enter_space, lattice
from player.grid_compiled import LANES, equal_mass, fetch, opacity_of, trilinear, weight_of
from player.march import MAX_TAU, MIN_OPACITY, SKIP_MARGIN, MarchResult
from player.sparse_grid import SparseGrid

F32 = np.float32


def march(
    grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, n_samples: int, bounds: None = None
) -> MarchResult:
    """`player.contracted_march.march`, compiled: same arguments, same result to float32 rounding."""
    n_rays = len(rays_o)
    rays = enter_space(grid, rays_o, rays_d)
    table = lattice(float(grid.step))
    capacity = table.shape[1]
    opacity, depth = np.zeros(n_rays, F32), np.zeros(n_rays, F32)
    counts, hits = np.zeros(n_rays, np.int32), np.empty(n_rays, np.int64)
    features = np.zeros((n_rays, grid.n_channels), F32)
    half = grid.step * F32(0.5)
    n_hits = _march_rays(
        (grid.resolution, grid.n_per_axis, grid.density_low, grid.density_slope, rays.cells),
        (np.cos(half), np.sin(half), np.sin(grid.step), MAX_SPEED * grid.step * rays.cells, capacity - SPARE),
        (grid.table, grid.live, grid.density),
        (grid.rows.bricks, grid.rows.base, grid.rows.ranks, grid.features),
        (grid.rows.resolution, grid.rows.n_per_axis, grid.feature_scale),
        (rays.nearest, rays.along, rays.t_nearest, rays.width, rays.cos, rays.sin, rays.length),
        table,
        n_samples,
        (np.empty(capacity, F32), np.empty(capacity, F32), np.empty((2, max(n_samples, 1)), F32)),
        (np.empty(8, np.int64), np.empty(8, F32)),
        np.zeros((1, -(-grid.n_channels // LANES) * LANES), F32),
        (opacity, depth, counts, features, hits),
    )  # fmt: skip
    return MarchResult(opacity, depth, counts, hits[:n_hits], features[:n_hits])


@compiled
def _march_rays(settings, steps, lookup, stored, sizes, rays, table, k, scratch, corners, composite, out):
    """Every ray: its samples into the scratch arrays, then its fetches into the next row of `features`."""
    nearest, along, t_nearest, width, cos0, sin0, length = rays
    scratch_s, scratch_w, _ = scratch
    opacity, depth, counts, features, hits = out
    n_hits = 0
    for index in range(len(length)):
        ray = (
            nearest[0, index], nearest[1, index], nearest[2, index],
            along[0, index], along[1, index], along[2, index], cos0[index], sin0[index],
        )  # fmt: skip
        n, taken, tau, total, moment = _collect(
            settings, steps, lookup, ray, width[index], length[index], table, scratch_s, scratch_w
        )
        counts[index] = taken
        if n == 0:
            continue
        mass = F32(opacity_of(tau))
        opacity[index] = mass
        mean = F32(moment / total)
        cos, sin = _turned(ray, F32(math.cos(mean)), F32(math.sin(mean)))
        depth[index] = t_nearest[index] + width[index] * sin / max(cos, MIN_COS)
        if mass > MIN_OPACITY:
            composite[:] = F32(0.0)
            _gather(stored, sizes, settings[4], ray, scratch, n, total, mass, k, corners, composite)
            for c in range(features.shape[1]):
                features[n_hits, c] = composite[0, c]
            hits[n_hits] = index
            n_hits += 1
    return n_hits


@inlined
def _turned(ray, cos_s, sin_s):
    """cos and sin of phi."""
    cos, sin = ray[6], ray[7]
    return cos * cos_s - sin * sin_s, sin * cos_s + cos * sin_s


@inlined
def _on_grid(ray, cos, sin, cells):
    """Grid coordinates of a place."""
    px, py, pz, ax, ay, az, _, _ = ray
    vx, vy, vz = cos * px + sin * ax, cos * py + sin * ay, cos * pz + sin * az
    q = F32(math.sqrt(vx * vx + vy * vy + vz * vz))
    if q <= cos:
        scale = F32(1) / cos
    else:
        scale = (F32(2) - cos / q) / q
    scale *= cells
    middle = cells * F32(2)
    return vx * scale + middle, vy * scale + middle, vz * scale + middle


@inlined
def _collect(settings, steps, lookup, ray, width, length, table, scratch_s, scratch_w):
    """March one ray: s and weight of each sample that has weight into the scratch arrays.

    Returns how many, the number of samples taken, tau, and the sums of w and of w s.
    """
    resolution, n_per_axis, low, slope, cells = settings
    cos_half, sin_half, sin_step, fastest, last_sample = steps
    slots, live, density = lookup
    last = resolution - 1
    tau = F32(0.0)
    trans = F32(1.0)
    total = 0.0
    moment = 0.0
    n = 0
    taken = 0
    i = 0
    while i < last_sample:
        s = table[0, i]
        if s >= length:
            break
        cos, sin = _turned(ray, table[1, i], table[2, i])
        gx, gy, gz = _on_grid(ray, cos, sin, cells)
        x, y, z = min(max(int(gx), 0), last), min(max(int(gy), 0), last), min(max(int(gz), 0), last)
        bx, by, bz = x >> 3, y >> 3, z >> 3
        slot = slots[(bx * n_per_axis + by) * n_per_axis + bz]
        if slot < 0:
            reach = -1 - slot
            free = min(_free(gx, bx, reach), min(_free(gy, by, reach), _free(gz, bz, reach)))
            i += max(int((free - SKIP_MARGIN) / fastest), 0) + 1
            continue
        i += 1
        lx, ly, lz = x & 7, y & 7, z & 7
        if (live[slot * 64 + lx * 8 + ly] >> lz) & 1 == 0:
            continue
        code = trilinear(density, slot * 729 + lx * 81 + ly * 9 + lz, gx - F32(x), gy - F32(y), gz - F32(z))
        a, b = cos * cos_half, sin * sin_half
        way = width * sin_step / (max(a + b, MIN_COS) * max(a - b, MIN_COS))
        optical = F32(math.exp(low + slope * code)) * way
        taken += 1
        tau += optical
        behind = F32(math.exp(-tau))
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
def _free(g, brick, reach):
    """Cells along one axis to the nearer border of the bricks within `reach` of `brick`."""
    return min(g - F32((brick - reach) * 8), F32((brick + reach + 1) * 8) - g)


@inlined
def _gather(stored, sizes, cells, ray, samples, n, total, mass, k, corners, out):
    """Choose the fetches of one ray and add them up in `out`."""
    scratch_s, scratch_w, places = samples
    if k == 0 or n <= k:
        for i in range(n):
            _fetch_at(stored, sizes, cells, ray, scratch_s[i], scratch_w[i], corners, out)
        return
    equal_mass(scratch_s, scratch_w, n, total, k, places)
    weight = mass / F32(k)
    for i in range(k):
        if not _fetch_at(stored, sizes, cells, ray, places[0, i], weight, corners, out):
            _fetch_at(stored, sizes, cells, ray, places[1, i], weight, corners, out)


@inlined
def _fetch_at(stored, sizes, cells, ray, s, weight, corners, out):
    """Add `weight` times the features at s to `out`; False, and nothing added, where too little is
    stored."""
    cos, sin = _turned(ray, F32(math.cos(s)), F32(math.sin(s)))
    place = _on_grid(ray, cos, sin, cells)
    still = (F32(0), F32(0), F32(0))
    return fetch(stored, sizes, place, still, F32(0), weight, corners, out)
