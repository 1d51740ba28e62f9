"""The march of `player.march.march`, compiled by numba: the same semantics, LANES rays at a time.

Its readable twin states the mathematics; the tests compare the two. Arithmetic that decides which cell a
sample falls into is float32 in the same order in both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from player.asset.grid import SparseGrid
from player.compiled.add_rows import CHANNELS, add_rows
from player.compiled.fetches import StoredFeatures, choose_fetches, stored_corners
from player.compiled.lanes import LANES
from player.compiled.packets import (
    BOX_ROWS,
    DEPTH,
    ENTRY,
    FIRST,
    LENGTH,
    N_SAMPLES,
    N_WEIGHTS,
    SPACE_ROWS,
    SUMS,
    TAU,
    BoxSteps,
    Lookup,
    SpaceSteps,
    march_packet,
    place_fetches,
)
from player.compiled.prefetch import prefetch
from player.compiling import compiled, inlined
from player.march.box import Bounds
from player.march.contracted import MAX_SPEED, MIN_COS, lattice
from player.march.fetches import MIN_TOTAL
from player.march.march import MAX_TAU, MIN_OPACITY, MarchResult
from player.scratch import check_scratch, scratch

F32 = np.float32


class Work(NamedTuple):
    """Work arrays for the march of a packet and its fetches."""

    samples: np.ndarray
    """[2, n, LANES] float32: s and weights of the samples."""
    sums: np.ndarray
    """[SUMS, LANES] float32: the results of the march, for each ray."""
    chosen: np.ndarray
    """[3, k, LANES] float32: the fetches that `choose_fetches` chooses."""
    masses: np.ndarray
    """[LANES] float32: opacities, 0 where nothing is fetched."""
    into: np.ndarray
    """[LANES] int64: the row of the found features that each ray's fetches are added to."""
    places: np.ndarray
    """[3, LANES] float32: the position of one fetch of each ray, in cells of the densities' grid."""
    weights: np.ndarray
    """[LANES] float32: the weights of these fetches."""
    rows: np.ndarray
    """[8, LANES] int32: rows of the features at the eight corners around the places."""
    shares: np.ndarray
    """[9, LANES] float32: shares of these rows, as `stored_corners` finds them."""


def march(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    n_fetches: int,
    bounds: Bounds | None = None,
    opaque_depth: np.float32 = MAX_TAU,
) -> MarchResult:
    """March rays and fetch their features: arguments and result are those of `player.march.march.march`, to
    float32 rounding."""
    lookup, steps, packets, capacity = enter(grid, rays_o, rays_d, bounds, opaque_depth)
    n_rays, width = len(rays_o), -(-grid.n_channels // CHANNELS) * CHANNELS
    k = min(n_fetches, capacity)  # no ray has more samples
    work = Work(
        samples=scratch((2, capacity, LANES), F32),
        sums=scratch((SUMS, LANES), F32),
        chosen=scratch((3, max(k, 1), LANES), F32, 0),
        masses=scratch(LANES, F32),
        into=scratch(LANES, np.int64),
        places=scratch((3, LANES), F32, 0),
        weights=scratch(LANES, F32),
        rows=scratch((8, LANES), np.int32),
        shares=scratch((9, LANES), F32),
    )
    found = MarchResult(  # with room for n_rays hits, and for features in whole registers
        opacity=scratch(n_rays, F32, 0),
        depth=scratch(n_rays, F32, 0),
        n_density_samples=scratch(n_rays, np.int32, 0),
        hits=scratch(n_rays, np.int64),
        features=scratch((n_rays, width), F32, 0),
    )
    vertices = grid.rows
    n_hits = _march_rays(
        lookup,
        StoredFeatures(
            vertices.bricks, vertices.rows, grid.features, vertices.resolution, vertices.n_per_axis,
            grid.feature_scale,
        ),
        steps, packets, k, work, found,
    )  # fmt: skip
    check_scratch(packets, work, found)
    opacity, depth, counts, hits, features = found
    return MarchResult(opacity, depth, counts, hits[:n_hits], features[:n_hits, : grid.n_channels])


class Entered(NamedTuple):
    """n rays where they begin, in the form that `march_packet` takes."""

    lookup: Lookup
    steps: BoxSteps | SpaceSteps
    packets: np.ndarray
    """[n_packets, BOX_ROWS or SPACE_ROWS, LANES] float32; the last packet may have lanes without a ray."""
    most_samples: int
    """The most samples that a ray can have."""


def enter(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    bounds: Bounds | None = None,
    opaque_depth: np.float32 = MAX_TAU,
) -> Entered:
    """Find where rays enter a grid of either kind; the arguments are those of `march`.

    Origins are copied: those of a single ray may be a contiguous array that is read-only, for which numba
    would compile again.
    """
    lookup = Lookup(
        grid.table, grid.live, grid.density, grid.level_steps, grid.resolution, grid.n_per_axis,
        int(grid.level_steps[0] == 1), grid.most_steps, grid.density_low, grid.density_slope,
        F32(opaque_depth),
    )  # fmt: skip
    if grid.contracted:
        steps, packets = _enter_space(grid, rays_o, rays_d)
        return Entered(lookup, steps, packets, steps.n_steps)
    return Entered(lookup, *_enter_box(grid, rays_o, rays_d, bounds), grid.most_samples)


def _enter_box(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    bounds: Bounds | None,
) -> tuple[BoxSteps, np.ndarray]:
    """Make the packets of rays through a box, [n_packets, BOX_ROWS, LANES] float32."""
    n_rays = len(rays_o)
    near, far = (np.zeros(n_rays, F32), np.full(n_rays, np.inf, F32)) if bounds is None else bounds
    packets = scratch((-(-n_rays // LANES), BOX_ROWS, LANES), F32, 0)
    _enter_rays(
        F32(grid.resolution), grid.aabb_min, grid.cells_per_unit, grid.step,
        F32(grid.most_samples - 1) * grid.step,  # there is no room for more samples, whatever the ray
        grid.most_steps,
        np.array(rays_o, F32, order="C"), np.ascontiguousarray(rays_d, F32), near, far, packets,
    )  # fmt: skip
    return BoxSteps(grid.step), packets


def _enter_space(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray) -> tuple[SpaceSteps, np.ndarray]:
    """Make the packets of rays through contracted space, [n_packets, SPACE_ROWS, LANES] float32."""
    packets = scratch((-(-len(rays_o) // LANES), SPACE_ROWS, LANES), F32, 0)
    _enter_curves(
        np.array(rays_o, F32, order="C"), np.ascontiguousarray(rays_d, F32), float(grid.near),
        math.acos(float(MIN_COS)), packets,
    )  # fmt: skip
    angle = np.arange(grid.level_steps[-1] + 1).astype(F32) * grid.step
    angles = np.stack([np.cos(angle * F32(0.5)), np.sin(angle * F32(0.5)), np.sin(angle)])
    table, cells = lattice(float(grid.step)), grid.cells_per_unit[0]
    middles, ends = (np.ascontiguousarray(table[1:, first::2].T) for first in (0, 1))
    fastest = MAX_SPEED * grid.step * cells
    sizes = len(middles), angles.shape[1]
    return SpaceSteps(middles, ends, grid.step, angles, *sizes, fastest, cells), packets


@compiled
def _enter_curves(rays_o, rays_d, near, end, packets):
    """Write where rays begin, as `player.march.contracted.enter_space` finds it, into rows of packets. The
    rays end where phi is `end`."""
    for ray in range(len(rays_o)):
        packet, lane = ray // LANES, ray % LANES
        nearest, squares = 0.0, 0.0
        for axis in range(3):
            nearest -= np.float64(rays_o[ray, axis]) * np.float64(rays_d[ray, axis])
        for axis in range(3):
            p = np.float64(rays_o[ray, axis]) + nearest * np.float64(rays_d[ray, axis])
            packets[packet, axis, lane] = p
            squares += p * p
        width = max(1.0, math.sqrt(squares))
        for axis in range(3):
            packets[packet, 3 + axis, lane] = width * np.float64(rays_d[ray, axis])
        way = near - nearest
        length = math.sqrt(width * width + way * way)
        packets[packet, 6, lane], packets[packet, 7, lane] = width / length, way / length
        packets[packet, 8, lane], packets[packet, 9, lane] = width, end - math.atan2(way, width)
        packets[packet, 10, lane] = nearest


@compiled
def _enter_rays(size, origin, scale, step, longest, most_steps, rays_o, rays_d, near, far, packets):
    """Write where rays enter the box of `size` cells into rows of packets."""
    for ray in range(len(rays_o)):
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
        packet, lane = ray // LANES, ray % LANES
        packets[packet, 0, lane] = min(max(ox + t_in * dx, F32(0.0)), size)
        packets[packet, 1, lane] = min(max(oy + t_in * dy, F32(0.0)), size)
        packets[packet, 2, lane] = min(max(oz + t_in * dz, F32(0.0)), size)
        packets[packet, 3, lane], packets[packet, 4, lane], packets[packet, 5, lane] = dx, dy, dz
        packets[packet, LENGTH, lane], packets[packet, ENTRY, lane] = length, t_in
        packets[packet, FIRST, lane] = max(math.floor(min(ahead, F32(1e9))), 0) & -most_steps


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


@compiled
def _march_rays(lookup, stored, steps, packets, k, work, found):
    """March packets of rays. For each packet, its samples are found first; then its features are fetched, one
    fetch of each ray at a time, and added to the ray's row. Returns the number of hits."""
    n_hits = 0
    for number in range(len(packets)):
        rows = march_packet(lookup, steps, packets, number, work.samples, work.sums)
        hits_before = n_hits
        n_hits = _take_hits(number * LANES, work, found, n_hits)
        if n_hits == hits_before:
            continue
        if k > 0:
            rows = choose_fetches(work.samples, rows, work.sums, work.masses, work.chosen)
        wanted = work.chosen if k > 0 else work.samples
        for j in range(rows):
            for lane in range(LANES):
                work.weights[lane] = wanted[1, j, lane] if work.masses[lane] > F32(0.0) else F32(0.0)
            place_fetches(steps, packets, number, wanted, j * LANES, work.places, work.weights)
            if _add_fetches(stored, work, found.features) > 0 and k > 0:
                other = (2 * wanted.shape[1] + j) * LANES  # where to fetch if little is stored at the first
                place_fetches(steps, packets, number, wanted, other, work.places, work.weights)
                _add_fetches(stored, work, found.features)
    return n_hits


@inlined
def _take_hits(start, work, found, n_hits):
    """Store the results of the packet's rays, which are those from `start` on. A visible ray is a hit, and
    gets a mass and a row of the features. Returns the number of hits so far."""
    work.masses[:] = F32(0.0)
    for lane in range(min(LANES, len(found.opacity) - start)):
        ray = start + lane
        found.n_density_samples[ray] = int(work.sums[N_SAMPLES, lane])
        if work.sums[N_WEIGHTS, lane] == F32(0.0):
            continue
        found.depth[ray] = work.sums[DEPTH, lane]
        found.opacity[ray] = opacity_of(work.sums[TAU, lane])
        if found.opacity[ray] > MIN_OPACITY:
            work.masses[lane], work.into[lane] = found.opacity[ray], n_hits
            found.hits[n_hits] = ray
            n_hits += 1
    return n_hits


@inlined
def opacity_of(tau):
    """Return 1 - exp(-tau) to float32 rounding: the difference in float64, or a series where that would
    cancel."""
    if tau < F32(1e-5):
        return tau - F32(0.5) * tau * tau
    return F32(1.0 - math.exp(-np.float64(tau)))


@inlined
def _add_fetches(stored, work, out):
    """Add one fetch of each ray to its row of `out`. Fetches where too little is stored keep their weight,
    all others get weight 0; returns the number of those that keep it."""
    features, weights, rows, shares = stored.features, work.weights, work.rows, work.shares
    most = stored_corners(stored, work.places, weights, rows, shares)
    n_channels = features.shape[1]
    whole = most * n_channels + out.shape[1] <= features.size  # else whole registers would reach past it
    for lane in range(LANES):
        if weights[lane] > F32(0.0):
            for corner in range(0, 8, 2):  # the corner next along z is in the next row
                prefetch(features, rows[corner, lane])
    left = 0
    for lane in range(LANES):
        if weights[lane] <= F32(0.0):
            continue
        if shares[8, lane] < MIN_TOTAL:
            left += 1
            continue
        weights[lane] = F32(0.0)
        into = work.into[lane]
        if whole:
            for first in range(0, n_channels, CHANNELS):
                add_rows(features, rows, shares, lane, out, into, first)
        else:
            for c in range(n_channels):  # in the order of `add_rows`
                a, b = _two(features, rows, shares, lane, 0, c), _two(features, rows, shares, lane, 2, c)
                d, e = _two(features, rows, shares, lane, 4, c), _two(features, rows, shares, lane, 6, c)
                out[into, c] += (a + b) + (d + e)
    return left


@inlined
def _two(features, rows, shares, lane, corner, c):
    one = shares[corner, lane] * features[rows[corner, lane], c]
    return one + shares[corner + 1, lane] * features[rows[corner + 1, lane], c]
