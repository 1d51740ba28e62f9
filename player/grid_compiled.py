"""Fetches of features in compiled code: where, and what.

Every function has its readable twin in `player.few_samples`.
"""

from __future__ import annotations

import math

import numpy as np

from player.compiling import inlined
from player.eight_rows import CHANNELS, add_rows
from player.few_samples import MIN_TOTAL
from player.lanes import LANES
from player.packets import stored_corners
from player.prefetch import prefetch

F32 = np.float32


@inlined
def opacity_of(tau):
    """1 - exp(-tau) to float32 rounding: the difference in float64, or the series where that would cancel."""
    if tau < F32(1e-5):
        return tau - F32(0.5) * tau * tau
    return F32(1.0 - math.exp(-np.float64(tau)))


@inlined
def equal_mass(scratch_s, scratch_w, n, total, k, places):
    """Cut the n samples of a ray into k bins of equal mass, in one pass (`player.few_samples`).

    Into `places` [2, >= k]: s of each bin's centroid, and of its heaviest sample.
    """
    share = total / k
    i = 0
    left = np.float64(scratch_w[0])
    for bin_ in range(k):
        need = share
        moment = 0.0
        heaviest = -1.0
        places[1, bin_] = scratch_s[i]
        while True:
            part = min(left, need)
            moment += part * scratch_s[i]
            if part > heaviest:
                heaviest = part
                places[1, bin_] = scratch_s[i]
            need -= part
            left -= part
            if left > 0.0 or i == n - 1:
                break
            i += 1
            left = np.float64(scratch_w[i])
            if need <= 0.0:
                break
        places[0, bin_] = F32(moment / share)


def scratch_arrays(capacity: int, k: int) -> tuple[np.ndarray, ...]:
    """For the samples of one ray, at most `capacity`: s, weight, another place; and [2, k] for
    `equal_mass`."""
    return *(np.empty(capacity, F32) for _ in range(3)), np.empty((2, max(k, 1)), F32)


@inlined
def samples_of_ray(samples, n_rows, lane, scratch):
    """What `player.packets` found on one ray into the scratch arrays: how many samples with weight, and the
    sums of w and of w s."""
    scratch_s, scratch_w, _, _ = scratch
    n, total, moment = 0, 0.0, 0.0
    for row in range(n_rows):
        weight = samples[1, row, lane]
        if weight > F32(0.0):
            s = samples[0, row, lane]
            scratch_s[n], scratch_w[n] = s, weight
            n += 1
            total += weight
            moment += np.float64(weight) * s
    return n, total, moment


@inlined
def choose_fetches(scratch, n, total, mass, k):
    """From the n samples of a ray to its fetches, in place; returns their number. The other place of a fetch
    is not a number where it has none."""
    scratch_s, scratch_w, others, places = scratch
    if k == 0 or n <= k:
        others[:n] = F32(np.nan)
        return n
    equal_mass(scratch_s, scratch_w, n, total, k, places)
    for j in range(k):
        scratch_s[j], scratch_w[j], others[j] = places[0, j], mass / F32(k), places[1, j]
    return k


def queue_arrays() -> tuple[np.ndarray, ...]:
    """LANES fetches: places [3, LANES] in cells of the densities' grid, weights, rows of the features they
    are added to, lanes of the packet, s of other places; and [8, LANES] and [9, LANES] for
    `stored_corners`."""
    numbers = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    corners = np.empty((8, LANES), np.int32), np.empty((9, LANES), F32)
    return np.zeros((3, LANES), F32), np.empty(LANES, F32), *numbers, np.empty(LANES, F32), *corners


@inlined
def enqueue(queue, at, place, weight, row, lane, other):
    places, weights, into, lanes, others, _, _ = queue
    places[0, at], places[1, at], places[2, at] = place
    weights[at], into[at], lanes[at], others[at] = weight, row, lane, other


@inlined
def add_fetches(stored, sizes, queue, n, out):
    """Add the first n fetches of the queue to their rows of `out`. Returns how many of them found too little
    stored but have another place to be tried: they are now the first of the queue."""
    places, weights, into, lanes, others, rows, shares = queue
    bricks, of_bricks, features = stored
    most = stored_corners((bricks, of_bricks), sizes, places, weights, rows, shares)
    n_channels = features.shape[1]
    whole = most * n_channels + out.shape[1] <= features.size  # or the last rows cannot be read in registers
    for j in range(n):
        for corner in range(0, 8, 2):  # the next along z is the next row
            prefetch(features, rows[corner, j])
    left = 0
    for j in range(n):
        if shares[8, j] < MIN_TOTAL:
            if not math.isnan(others[j]):
                weights[left], into[left], lanes[left], others[left] = (
                    weights[j],
                    into[j],
                    lanes[j],
                    others[j],
                )
                left += 1
        elif whole:
            for first in range(0, n_channels, CHANNELS):
                add_rows(features, rows, shares, j, out, into[j], first)
        else:
            for corner in range(8):
                for c in range(n_channels):
                    out[into[j], c] += shares[corner, j] * features[rows[corner, j], c]
    return left
