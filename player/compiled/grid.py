"""What both compiled marches do with a packet's samples: hits, and fetches, one of each ray at a time.

Every function has its readable twin in `player.march.fetches`.
"""

from __future__ import annotations

import math

import numpy as np

from player.compiled.add_rows import CHANNELS, add_rows
from player.compiled.compiling import inlined
from player.compiled.fetches import stored_corners
from player.compiled.lanes import LANES
from player.compiled.prefetch import prefetch
from player.compiled.scratch import scratch
from player.march.fetches import MIN_TOTAL
from player.march.march import MIN_OPACITY

F32 = np.float32


@inlined
def opacity_of(tau):
    """1 - exp(-tau) to float32 rounding: the difference in float64, or the series where that would cancel."""
    if tau < F32(1e-5):
        return tau - F32(0.5) * tau * tau
    return F32(1.0 - math.exp(-np.float64(tau)))


def fetch_arrays(k: int) -> tuple[np.ndarray, ...]:
    """For the fetches of a packet: `chosen` [3, k, LANES] of `choose_fetches`; opacities [LANES], 0 where
    nothing is fetched, and rows of the features [LANES] that the rays are added to; places [3, LANES], in
    cells of the densities' grid, and weights [LANES]; and [8, LANES] and [9, LANES] for `stored_corners`."""
    return (
        scratch((3, max(k, 1), LANES), F32, 0),
        scratch(LANES, F32),
        scratch(LANES, np.int64),
        scratch((3, LANES), F32, 0),
        scratch(LANES, F32),
        scratch((8, LANES), np.int32),
        scratch((9, LANES), F32),
    )


def result_arrays(n_rays: int, n_channels: int) -> tuple[np.ndarray, ...]:
    """For what a march finds: opacity, depth and counts of the rays [n_rays], the features of those that are
    hits [n_rays, whole CHANNELS], and which these are [n_rays]."""
    return (
        scratch(n_rays, F32, 0),
        scratch(n_rays, F32, 0),
        scratch(n_rays, np.int32, 0),
        scratch((n_rays, -(-n_channels // CHANNELS) * CHANNELS), F32, 0),
        scratch(n_rays, np.int64),
    )


@inlined
def take_hits(start, n_lanes, sums, fetches, out, n_hits):
    """Counts and opacities of the packet's rays, those from `start` on; a visible one is a hit, with a mass
    and a row of the features. Returns how many hits there are now."""
    _, masses, into, _, _, _, _ = fetches
    opacity, _, counts, _, hits = out
    masses[:] = F32(0.0)
    for lane in range(n_lanes):
        ray = start + lane
        counts[ray] = int(sums[1, lane])
        if sums[2, lane] == F32(0.0):
            continue
        opacity[ray] = opacity_of(sums[0, lane])
        if opacity[ray] > MIN_OPACITY:
            masses[lane], into[lane] = opacity[ray], n_hits
            hits[n_hits] = ray
            n_hits += 1
    return n_hits


@inlined
def add_fetches(stored, sizes, fetches, out):
    """Add a fetch of each ray to its row of `out`. Those that found too little stored keep their weight, all
    others lose it; returns their number."""
    _, _, into, places, weights, rows, shares = fetches
    bricks, of_bricks, features = stored
    most = stored_corners((bricks, of_bricks), sizes, places, weights, rows, shares)
    n_channels = features.shape[1]
    whole = most * n_channels + out.shape[1] <= features.size  # or the last rows cannot be read in registers
    for lane in range(LANES):
        if weights[lane] > F32(0.0):
            for corner in range(0, 8, 2):  # the next along z is the next row
                prefetch(features, rows[corner, lane])
    left = 0
    for lane in range(LANES):
        if weights[lane] <= F32(0.0):
            continue
        if shares[8, lane] < MIN_TOTAL:
            left += 1
            continue
        weights[lane] = F32(0.0)
        if whole:
            for first in range(0, n_channels, CHANNELS):
                add_rows(features, rows, shares, lane, out, into[lane], first)
        else:
            for c in range(n_channels):  # in the order of `add_rows`
                a, b = _two(features, rows, shares, lane, 0, c), _two(features, rows, shares, lane, 2, c)
                d, e = _two(features, rows, shares, lane, 4, c), _two(features, rows, shares, lane, 6, c)
                out[into[lane], c] += (a + b) + (d + e)
    return left


@inlined
def _two(features, rows, shares, lane, corner, c):
    one = shares[corner, lane] * features[rows[corner, lane], c]
    return one + shares[corner + 1, lane] * features[rows[corner + 1, lane], c]
