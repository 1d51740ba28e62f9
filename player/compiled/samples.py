"""The samples and the fetches of rays, one by one, with their positions, for callers that need more than a
picture: the compiled twins of `player.march.march.sample_rays`, and of `player.march.fetches` up to where
features are read."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np

from player.asset.grid import SparseGrid
from player.compiled.fetches import StoredFeatures, choose_fetches, stored_corners
from player.compiled.lanes import LANES
from player.compiled.march import enter, opacity_of
from player.compiled.packets import N_SAMPLES, SUMS, TAU, march_packet, march_packet_ways, place_fetches
from player.compiling import compiled
from player.march.fetches import MIN_TOTAL, Samples
from player.march.march import MIN_OPACITY
from player.scratch import check_scratch, scratch

F32 = np.float32
MOST_AT_ONCE = 1 << 20
"""Samples that are collected at a time before they are copied to the result: 34 MB."""


class PlacedSamples(NamedTuple):
    """n rays and their samples, as in `player.march.march.SampledRays`, and the samples' points."""

    samples: Samples
    ways: np.ndarray
    tau: np.ndarray
    n_density_samples: np.ndarray
    points: np.ndarray
    """[n_samples, 3] float32: the samples' grid coordinates, in cells of the finest level of the
    densities."""


class PlacedFetches(NamedTuple):
    """The feature fetches of n rays, ray by ray, in the order of the march."""

    ray: np.ndarray
    """[n_fetches] int64, the ray of each fetch."""
    points: np.ndarray
    """[n_fetches, 3] float32 places, in cells of the finest level of the densities."""
    weights: np.ndarray
    """[n_fetches] float32 compositing weights."""
    opacity: np.ndarray
    """[n] float32 opacity of the rays. Those of at most MIN_OPACITY have no fetches."""


class _Met(NamedTuple):
    """Buffers for samples: the columns of `Samples` and ways, [n] each, and points [n, 3]."""

    ray: np.ndarray
    s: np.ndarray
    weights: np.ndarray
    ways: np.ndarray
    points: np.ndarray


def sample_rays(
    grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, n_threads: int = 1
) -> PlacedSamples:
    """Find the samples of rays as `player.march.march.sample_rays` does, and their points as `Path.at` gives
    them. The result is the same to float32 rounding, whatever the number of threads."""
    firsts, parts = _in_threads(lambda o, d: _sample(grid, o, d), rays_o, rays_d, n_threads)
    for first, (met, *_) in zip(firsts, parts, strict=True):
        met.ray[:] += first
    met, tau, counts = zip(*parts, strict=True)
    ray, s, weights, ways, points = map(np.concatenate, zip(*met, strict=True))
    return PlacedSamples(Samples(ray, s, weights), ways, np.concatenate(tau), np.concatenate(counts), points)


def fetch_places(
    grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, k: int, n_threads: int = 1
) -> PlacedFetches:
    """Find where rays fetch features, `k` times each, or at each of their samples if there are fewer, as
    `player.march.fetches` states. The result is the same to float32 rounding, whatever the number of
    threads."""
    firsts, parts = _in_threads(lambda o, d: _fetch(grid, o, d, k), rays_o, rays_d, n_threads)
    for first, part in zip(firsts, parts, strict=True):
        part.ray[:] += first
    return PlacedFetches(*map(np.concatenate, zip(*parts, strict=True)))


Part = TypeVar("Part")


def _in_threads(
    some: Callable[[np.ndarray, np.ndarray], Part], rays_o: np.ndarray, rays_d: np.ndarray, n_threads: int
) -> tuple[range, list[Part]]:
    """Call `some` with the rays in `n_threads` parts of whole packets, which are the same as on one thread.
    Returns the number of the first ray of each part, and the results."""
    n_packets = -(-len(rays_o) // LANES)
    size = max(-(-n_packets // n_threads), 1) * LANES
    firsts = range(0, max(len(rays_o), 1), size)
    rays = [(rays_o[first : first + size], rays_d[first : first + size]) for first in firsts]
    if len(rays) == 1:
        return firsts, [some(*rays[0])]
    with ThreadPoolExecutor(n_threads) as pool:
        return firsts, list(pool.map(lambda part: some(*part), rays))


def _sample(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray) -> tuple[_Met, np.ndarray, np.ndarray]:
    """Return the samples of n rays, their optical depths [n] and numbers of density samples [n]."""
    lookup, steps, packets, most_samples = enter(grid, rays_o, rays_d)
    n_rays, room = len(rays_o), max(MOST_AT_ONCE, most_samples * LANES)
    samples, sums = scratch((3, most_samples, LANES), F32), scratch((SUMS, LANES), F32)
    tau, counts = scratch(n_rays, F32, 0), scratch(n_rays, np.int32, 0)
    s, weights, ways = (scratch(room, F32) for _ in range(3))
    met = _Met(scratch(room, np.int64), s, weights, ways, scratch((room, 3), F32))
    work = samples, sums, scratch((3, LANES), F32), scratch(LANES, F32), scratch(LANES, np.int64)
    parts, number = [], 0
    while number < len(packets):
        n, number = _sample_packets(lookup, steps, packets, number, work, met, tau, counts)
        parts.append([column[:n].copy() for column in met])
    check_scratch(packets, *work, tau, counts, met)
    columns = map(np.concatenate, zip(*parts, strict=True)) if parts else (column[:0] for column in met)
    return _Met(*columns), tau, counts


@compiled
def _sample_packets(lookup, steps, packets, number, work, met, tau, counts):
    """Write the samples with weight of the packets from `number` on to `met`, as long as there is room for
    those of another packet. Returns the number of samples, and the number of the packet to go on with."""
    samples, sums, places, weights, placed = work
    n, most = 0, len(met.ray) - samples.shape[1] * LANES
    while number < len(packets) and n <= most:
        rows = march_packet_ways(lookup, steps, packets, number, samples, sums)
        n_lanes = min(LANES, len(tau) - number * LANES)
        for lane in range(n_lanes):
            ray = number * LANES + lane
            tau[ray], counts[ray] = sums[TAU, lane], int(sums[N_SAMPLES, lane])
            placed[lane] = n
            for j in range(rows):
                if samples[1, j, lane] > F32(0.0):
                    met.ray[n], met.s[n] = ray, samples[0, j, lane]
                    met.weights[n], met.ways[n] = samples[1, j, lane], samples[2, j, lane]
                    n += 1
        for j in range(rows):
            for lane in range(LANES):
                weights[lane] = samples[1, j, lane]
            place_fetches(steps, packets, number, samples, j * LANES, places, weights)
            for lane in range(n_lanes):
                if samples[1, j, lane] > F32(0.0):
                    for axis in range(3):
                        met.points[placed[lane], axis] = places[axis, lane]
                    placed[lane] += 1
        number += 1
    return n, number


def _fetch(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, k: int) -> PlacedFetches:
    """Return the fetches of n rays."""
    lookup, steps, packets, capacity = enter(grid, rays_o, rays_d)
    n_rays, k, vertices = len(rays_o), min(k, capacity), grid.rows
    stored = StoredFeatures(
        vertices.bricks, vertices.rows, grid.features, vertices.resolution, vertices.n_per_axis,
        grid.feature_scale,
    )  # fmt: skip
    work = (
        scratch((2, capacity, LANES), F32),
        scratch((SUMS, LANES), F32),
        scratch((3, k, LANES), F32, 0),
        *(scratch(LANES, F32) for _ in range(2)),
        scratch((3, LANES), F32, 0),
        scratch((8, LANES), np.int32),
        scratch((9, LANES), F32),
        scratch(LANES, np.int64),
    )
    most = len(packets) * LANES * k
    found = PlacedFetches(
        scratch(most, np.int64), scratch((most, 3), F32), scratch(most, F32), scratch(n_rays, F32, 0)
    )
    n = _fetch_packets(lookup, stored, steps, packets, work, found)
    check_scratch(packets, work, found)
    return PlacedFetches(found.ray[:n], found.points[:n], found.weights[:n], found.opacity)


@compiled
def _fetch_packets(lookup, stored, steps, packets, work, found):
    """Write the fetches of all rays to `found`. Returns their number."""
    samples, sums, chosen, masses, weights, places, corners, shares, placed = work
    n = 0
    for number in range(len(packets)):
        rows = march_packet(lookup, steps, packets, number, samples, sums)
        n_lanes = min(LANES, len(found.opacity) - number * LANES)
        masses[:] = F32(0.0)
        for lane in range(n_lanes):
            opacity = found.opacity[number * LANES + lane] = opacity_of(sums[TAU, lane])
            masses[lane] = opacity if opacity > MIN_OPACITY else F32(0.0)
        rows = choose_fetches(samples, rows, sums, masses, chosen)
        for lane in range(n_lanes):
            placed[lane] = n
            for j in range(rows):
                if chosen[1, j, lane] > F32(0.0):  # the fetches of a ray are in its first rows
                    found.ray[n], found.weights[n] = number * LANES + lane, chosen[1, j, lane]
                    n += 1
        for j in range(rows):
            for lane in range(LANES):
                weights[lane] = chosen[1, j, lane] if lane < n_lanes else F32(0.0)
            place_fetches(steps, packets, number, chosen, j * LANES, places, weights)
            stored_corners(stored, places, weights, corners, shares)
            for lane in range(n_lanes):
                if weights[lane] > F32(0.0):
                    for axis in range(3):
                        found.points[placed[lane] + j, axis] = places[axis, lane]
                if shares[8, lane] >= MIN_TOTAL:
                    weights[lane] = F32(0.0)
            other = (2 * chosen.shape[1] + j) * LANES  # where to fetch if little is stored at the first
            place_fetches(steps, packets, number, chosen, other, places, weights)
            for lane in range(n_lanes):
                if weights[lane] > F32(0.0):
                    for axis in range(3):
                        found.points[placed[lane] + j, axis] = places[axis, lane]
    return n
