"""The samples of rays one by one, for those who want more of them than a picture: the compiled twin of
`player.march.march.sample_rays`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.asset.grid import SparseGrid
from player.compiled.lanes import LANES
from player.compiled.march import enter
from player.compiled.packets import N_SAMPLES, SUMS, TAU, march_packet_ways
from player.compiling import compiled
from player.march.fetches import Samples
from player.march.march import SampledRays
from player.march.path import path_of
from player.scratch import check_scratch, scratch

F32 = np.float32
MOST_AT_ONCE = 1 << 20
"""Samples that are held beside those that are handed out: 20 MB."""


class _Met(NamedTuple):
    """Samples as they are found, [n] each: the columns of `Samples`, and ways."""

    ray: np.ndarray
    s: np.ndarray
    weights: np.ndarray
    ways: np.ndarray


def sample_rays(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray) -> SampledRays:
    """`player.march.march.sample_rays`, compiled: same result to float32 rounding."""
    lookup, steps, packets, most_samples = enter(grid, rays_o, rays_d)
    n_rays, room = len(rays_o), max(MOST_AT_ONCE, most_samples * LANES)
    samples, sums = scratch((3, most_samples, LANES), F32), scratch((SUMS, LANES), F32)
    tau, counts = scratch(n_rays, F32, 0), scratch(n_rays, np.int32, 0)
    met = _Met(scratch(room, np.int64), *(scratch(room, F32) for _ in range(3)))
    parts, number = [], 0
    while number < len(packets):
        n, number = _sample_packets(lookup, steps, packets, number, samples, sums, met, tau, counts)
        parts.append([column[:n].copy() for column in met])
    check_scratch(packets, samples, sums, tau, counts, met)
    ray, s, weights, ways = (
        (np.concatenate(column) for column in zip(*parts, strict=True))
        if parts
        else (column[:0] for column in met)
    )
    return SampledRays(path_of(grid, rays_o, rays_d), Samples(ray, s, weights), ways, tau, counts)


@compiled
def _sample_packets(lookup, steps, packets, number, samples, sums, met, tau, counts):
    """The samples with weight of the packets from `number` on, as long as there is room for those of another.
    Returns their number, and that of the packet to go on with."""
    n, most = 0, len(met.ray) - samples.shape[1] * LANES
    while number < len(packets) and n <= most:
        rows = march_packet_ways(lookup, steps, packets, number, samples, sums)
        for lane in range(min(LANES, len(tau) - number * LANES)):
            ray = number * LANES + lane
            tau[ray], counts[ray] = sums[TAU, lane], int(sums[N_SAMPLES, lane])
            for j in range(rows):
                if samples[1, j, lane] > F32(0.0):
                    met.ray[n], met.s[n] = ray, samples[0, j, lane]
                    met.weights[n], met.ways[n] = samples[1, j, lane], samples[2, j, lane]
                    n += 1
        number += 1
    return n, number
