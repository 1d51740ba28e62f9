"""The march of `player.march.march`, compiled by numba: the same semantics, LANES rays at a time.

Every function has its readable twin in `player.march.march`, whose docstring states the mathematics; the
tests compare the two. Arithmetic that decides which cell a sample falls into is float32 in the same order in
both.
"""

from __future__ import annotations

import math

import numpy as np

from player.asset.grid import SparseGrid
from player.compiled.compiling import compiled, inlined
from player.compiled.fetches import choose_fetches
from player.compiled.grid import LANES, add_fetches, fetch_arrays, result_arrays, take_hits
from player.compiled.packets import BOX_ROWS, SUMS, march_box
from player.compiled.scratch import check_scratch, scratch
from player.march.march import MarchResult

F32 = np.float32


def march(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    n_fetches: int,
    bounds: tuple[np.ndarray, np.ndarray] | None = None,
) -> MarchResult:
    """`player.march.march.march`, compiled: same arguments, same result to float32 rounding."""
    n_rays = len(rays_o)
    near = np.zeros(n_rays, F32) if bounds is None else bounds[0]
    far = np.full(n_rays, np.inf, F32) if bounds is None else bounds[1]
    capacity = grid.most_samples
    k = min(n_fetches, capacity)  # no ray has more samples
    out = result_arrays(n_rays, grid.n_channels)
    packet = scratch((BOX_ROWS + 1, LANES), F32, 0), scratch(LANES, np.int32)
    found = scratch((2, capacity, LANES), F32), scratch((SUMS, LANES), F32)
    fetches = fetch_arrays(k)
    origin, scale = tuple(grid.aabb_min), tuple(grid.cells_per_unit)
    n_hits = _march_rays(
        (grid.resolution, grid.n_per_axis, grid.step, grid.density_low, grid.density_slope, origin, scale),
        (grid.table, grid.live, grid.density),
        (grid.rows.bricks, grid.rows.rows, grid.features),
        (grid.rows.resolution, grid.rows.n_per_axis, grid.feature_scale),
        (np.ascontiguousarray(rays_o, F32), np.ascontiguousarray(rays_d, F32), near, far),
        k,
        packet,
        found,
        fetches,
        out,
    )
    check_scratch(packet, found, fetches, out)
    opacity, depth, counts, features, hits = out
    return MarchResult(opacity, depth, counts, hits[:n_hits], features[:n_hits, : grid.n_channels])


@compiled
def _march_rays(settings, lookup, stored, sizes, rays, k, packet, found, fetches, out):
    """Packets of rays: their samples first, then a fetch of each ray at a time into its row of `features`."""
    resolution, n_per_axis, step, low, slope, _, _ = settings
    entered, first = packet
    samples, sums = found
    chosen, masses, _, _, _, _, _ = fetches
    _, depth, _, features, _ = out
    n_rays, n_hits = len(depth), 0
    longest = F32(samples.shape[1] - 1) * step  # there is no room for more, whatever the ray
    for start in range(0, n_rays, LANES):
        n_lanes = min(LANES, n_rays - start)
        _enter(settings, rays, start, n_lanes, longest, entered, first)
        rows = march_box(lookup, (resolution, n_per_axis, low, slope), step, entered, first, samples, sums)
        hits_before = n_hits
        n_hits = take_hits(start, n_lanes, sums, fetches, out, n_hits)
        for lane in range(n_lanes):
            if sums[2, lane] > F32(0.0):
                depth[start + lane] = entered[BOX_ROWS, lane] + sums[4, lane] / sums[3, lane]
        if n_hits == hits_before:
            continue
        if k > 0:
            rows = choose_fetches(samples, rows, sums, masses, chosen)
        wanted = chosen if k > 0 else samples
        for j in range(rows):
            _fetch(stored, sizes, entered, wanted, j, k > 0, fetches, features)
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
        ahead = max(near[ray] - t_in, F32(0.0)) / step - F32(0.5)
        first[lane] = max(math.floor(min(ahead, F32(1e9))), 0)
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
def _fetch(stored, sizes, entered, table, j, again, fetches, features):
    """Add fetch j of every ray that has one: s and weights of `table`; `again` at the other place where
    little is stored."""
    _, masses, _, _, weights, _, _ = fetches
    for lane in range(LANES):
        weights[lane] = table[1, j, lane] if masses[lane] > F32(0.0) else F32(0.0)
    _place(entered, table, 0, j, fetches)
    if add_fetches(stored, sizes, fetches, features) > 0 and again:
        _place(entered, table, 2, j, fetches)
        add_fetches(stored, sizes, fetches, features)


@inlined
def _place(entered, table, which, j, fetches):
    """Grid coordinates at s on every ray."""
    _, _, _, places, weights, _, _ = fetches
    for lane in range(LANES):
        s = table[which, j, lane]
        if math.isnan(s):
            weights[lane], s = F32(0.0), F32(0.0)
        places[0, lane] = entered[0, lane] + s * entered[3, lane]
        places[1, lane] = entered[1, lane] + s * entered[4, lane]
        places[2, lane] = entered[2, lane] + s * entered[5, lane]
