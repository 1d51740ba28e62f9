"""How much the samples of rays weigh in the blocks of a stored grid, as the player marches them."""

from __future__ import annotations

from player.compiled.lanes import LANES
from player.compiled.packets import march_packet, place_fetches
from vfr_bake.kernels import njit

BLOCKS = 4
"""Blocks of two cells along each edge of a brick."""


@njit(cache=True, error_model="numpy")
def add_sample_weights(lookup, steps, packets, samples, sums, places, weights, totals):
    """Add the weights of all samples of the rays in `packets` to `totals` [n_slots * BLOCKS**3] float64, at
    the slot and the block of 2 x 2 x 2 cells of the finest level that each is in.

    The grid has one level. `samples` [2, n, LANES], `sums`, `places` [3, LANES] and `weights` [LANES] float32
    are worked in.
    """
    last, n_per_axis = lookup.resolution - 1, lookup.n_per_axis
    for number in range(len(packets)):
        rows = march_packet(lookup, steps, packets, number, samples, sums)
        for j in range(rows):
            for lane in range(LANES):
                weights[lane] = samples[1, j, lane]
            place_fetches(steps, packets, number, samples, j * LANES, places, weights)
            for lane in range(LANES):
                if not weights[lane] > 0:
                    continue
                x = min(max(int(places[0, lane]), 0), last)
                y = min(max(int(places[1, lane]), 0), last)
                z = min(max(int(places[2, lane]), 0), last)
                slot = lookup.table[((x >> 3) * n_per_axis + (y >> 3)) * n_per_axis + (z >> 3)] >> 3
                if slot >= 0:  # a place found again may round to the brick beside its own
                    block = ((x & 7) >> 1) * 16 + ((y & 7) >> 1) * 4 + ((z & 7) >> 1)
                    totals[slot * 64 + block] += weights[lane]


@njit(cache=True)
def add_corner_weights(rows, shares, weights, totals):
    """Add the `weights` [n] of samples to `totals` [n_vertices] at the eight corners around each, `rows` [n,
    8], by their `shares` [n, 8]."""
    for i in range(rows.shape[0]):
        for corner in range(8):
            totals[rows[i, corner]] += weights[i] * shares[i, corner]
