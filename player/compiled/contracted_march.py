"""The march of `player.march.contracted_march`, compiled by numba: the same semantics, LANES rays at a time.

Its readable twin states the mathematics; the tests compare the two. Arithmetic that decides which cell a
sample falls into is float32 in the same order in both.
"""

from __future__ import annotations

import math

import numpy as np

from player.asset.grid import SparseGrid
from player.compiled.compiling import compiled, inlined
from player.compiled.fetches import choose_fetches
from player.compiled.grid import LANES, add_fetches, fetch_arrays, result_arrays, take_hits
from player.compiled.packets import SPACE_ROWS, SUMS, march_space
from player.compiled.scratch import check_scratch, scratch
from player.march.contracted import MAX_SPEED, MIN_COS, enter_space, lattice
from player.march.march import MarchResult

F32 = np.float32


def march(
    grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, n_fetches: int, bounds: None = None
) -> MarchResult:
    """`player.march.contracted_march.march`, compiled: same arguments, same result to float32 rounding."""
    n_rays = len(rays_o)
    rays = enter_space(grid, rays_o, rays_d)
    table = lattice(float(grid.step))
    capacity = table.shape[1]
    k = min(n_fetches, capacity)  # no ray has more samples
    out = result_arrays(n_rays, grid.n_channels)
    packet = scratch((SPACE_ROWS + 1, LANES), F32, 0)
    found = scratch((2, capacity, LANES), F32), scratch((SUMS, LANES), F32)
    fetches = fetch_arrays(k)
    half = grid.step * F32(0.5)
    n_hits = _march_rays(
        (grid.resolution, grid.n_per_axis, grid.density_low, grid.density_slope),
        (np.cos(half), np.sin(half), np.sin(grid.step), MAX_SPEED * grid.step * rays.cells, rays.cells),
        (grid.table, grid.live, grid.density),
        (grid.rows.bricks, grid.rows.rows, grid.features),
        (grid.rows.resolution, grid.rows.n_per_axis, grid.feature_scale),
        (*rays.nearest, *rays.along, rays.cos, rays.sin, rays.width, rays.length, rays.t_nearest),
        table,
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
def _march_rays(settings, steps, lookup, stored, sizes, rays, table, k, entered, found, fetches, out):
    """Packets of rays: their samples first, then a fetch of each ray at a time into its row of `features`."""
    samples, sums = found
    chosen, masses, _, _, _, _, _ = fetches
    _, depth, _, features, _ = out
    n_rays, n_hits = len(depth), 0
    for start in range(0, n_rays, LANES):
        n_lanes = min(LANES, n_rays - start)
        for row in range(len(rays)):
            for lane in range(LANES):
                entered[row, lane] = rays[row][start + lane] if lane < n_lanes else F32(0.0)
        rows = march_space(lookup, settings, table, steps, entered, samples, sums)
        hits_before = n_hits
        n_hits = take_hits(start, n_lanes, sums, fetches, out, n_hits)
        for lane in range(n_lanes):
            if sums[2, lane] > F32(0.0):
                cos, sin = _turned(entered, lane, sums[4, lane] / sums[3, lane])
                depth[start + lane] = entered[SPACE_ROWS, lane] + entered[8, lane] * sin / max(cos, MIN_COS)
        if n_hits == hits_before:
            continue
        if k > 0:
            rows = choose_fetches(samples, rows, sums, masses, chosen)
        wanted = chosen if k > 0 else samples
        for j in range(rows):
            _fetch(stored, sizes, entered, steps[4], wanted, j, k > 0, fetches, features)
    return n_hits


@inlined
def _turned(entered, lane, s):
    """cos and sin of phi at s on the ray of a lane."""
    cos, sin = entered[6, lane], entered[7, lane]
    cos_s, sin_s = F32(math.cos(s)), F32(math.sin(s))
    return cos * cos_s - sin * sin_s, sin * cos_s + cos * sin_s


@inlined
def _fetch(stored, sizes, entered, cells, table, j, again, fetches, features):
    """Add fetch j of every ray that has one: s and weights of `table`; `again` at the other place where
    little is stored."""
    _, masses, _, _, weights, _, _ = fetches
    for lane in range(LANES):
        weights[lane] = table[1, j, lane] if masses[lane] > F32(0.0) else F32(0.0)
    _place(entered, table, 0, j, cells, fetches)
    if add_fetches(stored, sizes, fetches, features) > 0 and again:
        _place(entered, table, 2, j, cells, fetches)
        add_fetches(stored, sizes, fetches, features)


@inlined
def _place(entered, table, which, j, cells, fetches):
    """Grid coordinates at s on every ray with a weight."""
    _, _, _, places, weights, _, _ = fetches
    middle = cells * F32(2)
    for lane in range(LANES):
        s = table[which, j, lane]
        if math.isnan(s):
            weights[lane] = F32(0.0)
        if weights[lane] <= F32(0.0):
            continue
        cos, sin = _turned(entered, lane, s)
        vx = cos * entered[0, lane] + sin * entered[3, lane]
        vy = cos * entered[1, lane] + sin * entered[4, lane]
        vz = cos * entered[2, lane] + sin * entered[5, lane]
        q = F32(math.sqrt(vx * vx + vy * vy + vz * vz))
        if q <= cos:
            scale = F32(1) / cos
        else:
            scale = (F32(2) - cos / q) / q
        scale *= cells
        places[0, lane], places[1, lane], places[2, lane] = (
            vx * scale + middle,
            vy * scale + middle,
            vz * scale + middle,
        )
