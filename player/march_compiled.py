"""The march of `player.march`, compiled by numba: the same semantics, LANES rays at a time.

Every function has its readable twin in `player.march`, whose docstring states the mathematics; the tests
compare the two. Arithmetic that decides which cell a sample falls into is float32 in the same order in both.
"""

from __future__ import annotations

import math

import numpy as np

from player.compiling import compiled, inlined
from player.grid_compiled import (
    CHANNELS,
    LANES,
    add_fetches,
    choose_fetches,
    enqueue,
    opacity_of,
    queue_arrays,
    samples_of_ray,
    scratch_arrays,
)
from player.march import MIN_OPACITY, MarchResult
from player.packets import BOX_ROWS, march_box
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
    features = np.zeros((n_rays, -(-grid.n_channels // CHANNELS) * CHANNELS), F32)
    capacity = grid.most_samples
    origin, scale = tuple(grid.aabb_min), tuple(grid.cells_per_unit)
    n_hits = _march_rays(
        (grid.resolution, grid.n_per_axis, grid.step, grid.density_low, grid.density_slope, origin, scale),
        (grid.table, grid.live, grid.density),
        (grid.rows.bricks, grid.rows.rows, grid.features),
        (grid.rows.resolution, grid.rows.n_per_axis, grid.feature_scale),
        (np.ascontiguousarray(rays_o, F32), np.ascontiguousarray(rays_d, F32), near, far),
        n_samples,
        (np.zeros((BOX_ROWS + 1, LANES), F32), np.empty(LANES, np.int32)),
        (np.empty((2, capacity, LANES), F32), np.empty((2, LANES), F32)),
        scratch_arrays(capacity, n_samples),
        queue_arrays(),
        (opacity, depth, counts, features, hits),
    )  # fmt: skip
    return MarchResult(opacity, depth, counts, hits[:n_hits], features[:n_hits, : grid.n_channels])


@compiled
def _march_rays(settings, lookup, stored, sizes, rays, k, packet, found, scratch, queue, out):
    """Packets of rays: their samples first, then ray by ray the fetches into the next row of `features`."""
    resolution, n_per_axis, step, low, slope, _, _ = settings
    entered, first = packet
    samples, sums = found
    opacity, depth, counts, features, hits = out
    n_rays, n_hits = len(opacity), 0
    longest = F32(samples.shape[1] - 1) * step  # there is no room for more, whatever the ray
    for start in range(0, n_rays, LANES):
        n_lanes = min(LANES, n_rays - start)
        _enter(settings, rays, start, n_lanes, longest, entered, first)
        rows = march_box(lookup, (resolution, n_per_axis, low, slope), step, entered, first, samples, sums)
        n_queued = 0
        for lane in range(n_lanes):
            ray = start + lane
            counts[ray] = int(sums[1, lane])
            n, total, moment = samples_of_ray(samples, rows, lane, scratch)
            if n == 0:
                continue
            mass = F32(opacity_of(sums[0, lane]))
            opacity[ray] = mass
            depth[ray] = entered[BOX_ROWS, lane] + F32(moment / total)
            if mass <= MIN_OPACITY:
                continue
            for j in range(choose_fetches(scratch, n, total, mass, k)):
                place = _place(entered, lane, scratch[0][j])
                enqueue(queue, n_queued, place, scratch[1][j], n_hits, lane, scratch[2][j])
                n_queued += 1
                while n_queued == LANES:
                    n_queued = _fetch(stored, sizes, queue, n_queued, entered, features)
            hits[n_hits] = ray
            n_hits += 1
        while n_queued > 0:
            n_queued = _fetch(stored, sizes, queue, n_queued, entered, features)
    return n_hits


@inlined
def _enter(settings, rays, start, n_lanes, longest, entered, first):
    """The rays from `start` on, where they enter the box: the rows of `march_box`, and t_in."""
    resolution, _, step, _, _, origin, scale = settings
    rays_o, rays_d, near, far = rays
    size = F32(resolution)
    first[:] = 0
    entered[6] = F32(0.0)
    for lane in range(n_lanes):
        ray = start + lane
        dx, dy, dz = rays_d[ray, 0] * scale[0], rays_d[ray, 1] * scale[1], rays_d[ray, 2] * scale[2]
        ox = (rays_o[ray, 0] - origin[0]) * scale[0]
        oy = (rays_o[ray, 1] - origin[1]) * scale[1]
        oz = (rays_o[ray, 2] - origin[2]) * scale[2]
        t_in, t_out = _slab(ox, dx, size, F32(0.0), F32(np.inf))
        t_in, t_out = _slab(oy, dy, size, t_in, t_out)
        t_in, t_out = _slab(oz, dz, size, t_in, t_out)
        length = min(min(t_out - t_in, longest), far[ray] - t_in)
        if not length > F32(0.0):
            continue
        first[lane] = max(math.floor(max(near[ray] - t_in, F32(0.0)) / step - F32(0.5)), 0)
        entered[0, lane] = min(max(ox + t_in * dx, F32(0.0)), size)
        entered[1, lane] = min(max(oy + t_in * dy, F32(0.0)), size)
        entered[2, lane] = min(max(oz + t_in * dz, F32(0.0)), size)
        entered[3, lane], entered[4, lane], entered[5, lane] = dx, dy, dz
        entered[6, lane], entered[7, lane] = length, t_in


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
def _place(entered, lane, s):
    """Grid coordinates at s on the ray of a lane."""
    return (
        entered[0, lane] + s * entered[3, lane],
        entered[1, lane] + s * entered[4, lane],
        entered[2, lane] + s * entered[5, lane],
    )


@inlined
def _fetch(stored, sizes, queue, n, entered, features):
    """Add the n queued fetches; those that have to be tried elsewhere stay, their number is returned."""
    n_left = add_fetches(stored, sizes, queue, n, features)
    places, _, _, lanes, others, _, _ = queue
    for j in range(n_left):
        places[0, j], places[1, j], places[2, j] = _place(entered, lanes[j], others[j])
        others[j] = F32(np.nan)
    return n_left
