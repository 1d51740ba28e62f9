"""The march of `player.contracted_march`, compiled by numba: the same semantics, LANES rays at a time.

Its readable twin states the mathematics; the tests compare the two. Arithmetic that decides which cell a
sample falls into is float32 in the same order in both.
"""

from __future__ import annotations

import math

import numpy as np

from player.compiling import compiled, inlined
from player.contracted_rays import MAX_SPEED, MIN_COS, enter_space, lattice
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
from player.packets import SPACE_ROWS, march_space
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
    features = np.zeros((n_rays, -(-grid.n_channels // CHANNELS) * CHANNELS), F32)
    half = grid.step * F32(0.5)
    n_hits = _march_rays(
        (grid.resolution, grid.n_per_axis, grid.density_low, grid.density_slope),
        (np.cos(half), np.sin(half), np.sin(grid.step), MAX_SPEED * grid.step * rays.cells, rays.cells),
        (grid.table, grid.live, grid.density),
        (grid.rows.bricks, grid.rows.rows, grid.features),
        (grid.rows.resolution, grid.rows.n_per_axis, grid.feature_scale),
        (*rays.nearest, *rays.along, rays.cos, rays.sin, rays.width, rays.length, rays.t_nearest),
        table,
        n_samples,
        np.zeros((SPACE_ROWS + 1, LANES), F32),
        (np.empty((2, capacity, LANES), F32), np.empty((2, LANES), F32)),
        scratch_arrays(capacity, n_samples),
        queue_arrays(),
        (opacity, depth, counts, features, hits),
    )  # fmt: skip
    return MarchResult(opacity, depth, counts, hits[:n_hits], features[:n_hits, : grid.n_channels])


@compiled
def _march_rays(settings, steps, lookup, stored, sizes, rays, table, k, entered, found, scratch, queue, out):
    """Packets of rays: their samples first, then ray by ray the fetches into the next row of `features`."""
    samples, sums = found
    opacity, depth, counts, features, hits = out
    n_rays, n_hits = len(opacity), 0
    for start in range(0, n_rays, LANES):
        n_lanes = min(LANES, n_rays - start)
        for row in range(len(rays)):
            for lane in range(LANES):
                entered[row, lane] = rays[row][start + lane] if lane < n_lanes else F32(0.0)
        rows = march_space(lookup, settings, table, steps, entered, samples, sums)
        n_queued = 0
        for lane in range(n_lanes):
            ray = start + lane
            counts[ray] = int(sums[1, lane])
            n, total, moment = samples_of_ray(samples, rows, lane, scratch)
            if n == 0:
                continue
            mass = F32(opacity_of(sums[0, lane]))
            opacity[ray] = mass
            cos, sin = _turned(entered, lane, F32(moment / total))
            depth[ray] = entered[SPACE_ROWS, lane] + entered[8, lane] * sin / max(cos, MIN_COS)
            if mass <= MIN_OPACITY:
                continue
            for j in range(choose_fetches(scratch, n, total, mass, k)):
                place = _place(entered, lane, scratch[0][j], steps[4])
                enqueue(queue, n_queued, place, scratch[1][j], n_hits, lane, scratch[2][j])
                n_queued += 1
                while n_queued == LANES:
                    n_queued = _fetch(stored, sizes, queue, n_queued, entered, steps[4], features)
            hits[n_hits] = ray
            n_hits += 1
        while n_queued > 0:
            n_queued = _fetch(stored, sizes, queue, n_queued, entered, steps[4], features)
    return n_hits


@inlined
def _turned(entered, lane, s):
    """cos and sin of phi at s on the ray of a lane."""
    cos, sin = entered[6, lane], entered[7, lane]
    cos_s, sin_s = F32(math.cos(s)), F32(math.sin(s))
    return cos * cos_s - sin * sin_s, sin * cos_s + cos * sin_s


@inlined
def _place(entered, lane, s, cells):
    """Grid coordinates at s on the ray of a lane."""
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
    middle = cells * F32(2)
    return vx * scale + middle, vy * scale + middle, vz * scale + middle


@inlined
def _fetch(stored, sizes, queue, n, entered, cells, features):
    """Add the n queued fetches; those that have to be tried elsewhere stay, their number is returned."""
    n_left = add_fetches(stored, sizes, queue, n, features)
    places, _, _, lanes, others, _, _ = queue
    for j in range(n_left):
        places[0, j], places[1, j], places[2, j] = _place(entered, lanes[j], others[j], cells)
        others[j] = F32(np.nan)
    return n_left
