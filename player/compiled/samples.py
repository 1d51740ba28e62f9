"""The single samples of rays and their positions, for callers that need more than a picture: the compiled
twin of `player.march.march.sample_rays`."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from player.asset.grid import SparseGrid
from player.compiled.lanes import LANES
from player.compiled.march import enter
from player.compiled.packets import N_SAMPLES, SUMS, TAU, march_packet_ways, place_fetches
from player.compiling import compiled
from player.march.fetches import Samples
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
    n_packets = -(-len(rays_o) // LANES)
    size = max(-(-n_packets // n_threads), 1) * LANES  # whole packets, the same as on one thread
    firsts = range(0, max(len(rays_o), 1), size)
    rays = [(rays_o[first : first + size], rays_d[first : first + size]) for first in firsts]
    if len(rays) == 1:
        parts = [_sample(grid, *rays[0])]
    else:
        with ThreadPoolExecutor(n_threads) as pool:
            parts = list(pool.map(lambda some: _sample(grid, *some), rays))
    for first, (met, *_) in zip(firsts, parts, strict=True):
        met.ray[:] += first
    met, tau, counts = zip(*parts, strict=True)
    ray, s, weights, ways, points = map(np.concatenate, zip(*met, strict=True))
    return PlacedSamples(Samples(ray, s, weights), ways, np.concatenate(tau), np.concatenate(counts), points)


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
