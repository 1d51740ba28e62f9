"""Adam for a hash table (Kingma & Ba 2015, algorithm 1): only entries that received a gradient are
stepped."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from player.compiled.prefetch import prefetch
from vfr_bake.kernels import njit
from vfr_bake.kernels.hash_grid import FLAGS, scatter_level

AHEAD = 16
"""Number of rows by which memory is prefetched ahead: a row takes as long to arrive as this many take to
step."""


class AdamRates(NamedTuple):
    """Learning rate and decay rates of one step."""

    rate: np.float32
    """Learning rate, corrected for moments that begin at 0."""
    beta1: np.float32
    beta2: np.float32
    """Decay rates of the means of the gradient and of its square."""
    epsilon: np.float32
    """Added to the denominator."""


@njit(inline="always")
def _step_row(row, table, moments, grad_row, grad, rates):
    """Step `table[row]` along `grad[grad_row]`, and clear that gradient. `moments[row]` holds the moving
    means of the gradient, followed by those of its square."""
    rate, beta1, beta2, epsilon = rates
    one = table.dtype.type(1)
    n = table.shape[1]
    for c in range(n):
        g = grad[grad_row, c]
        m = beta1 * moments[row, c] + (one - beta1) * g
        v = beta2 * moments[row, n + c] + (one - beta2) * g * g
        moments[row, c] = m
        moments[row, n + c] = v
        table[row, c] -= rate * m / (np.sqrt(v) + epsilon)
        grad[grad_row, c] = 0


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def adam_step(table, grad, moments, rates):
    """Step the rows of `table` [n_entries, n_channels] that have a gradient, in place, and clear the
    gradient. `grad` has the table's shape, `moments` is [n_entries, 2 * n_channels].

    A step touches a few percent of the entries; the others keep their moments, as in instant-ngp.
    """
    n = table.shape[1]
    for row in prange(table.shape[0]):
        touched = False
        for c in range(n):
            touched |= grad[row, c] != 0
        if touched:
            _step_row(row, table, moments, row, grad, rates)


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def scatter_and_step(points, grad_features, grid, grad, rows, moments, rates):
    """Do what `hash_grid.scatter` and `adam_step` do, level by level, so that a level's gradient is still in
    the cache when its rows are stepped.

    `grad` [n_threads, largest level, 2] holds the gradient of one level for each thread; it is zero before
    and after. A step therefore moves 24 bytes a row through memory (entry and moments), not 32. `rows`
    [n_threads, 8 n_points + 1] is scratch.
    """
    table, scales, offsets, hashed, mask = grid
    n_threads, n_levels = grad.shape[0], scales.shape[0]
    for thread in prange(n_threads):
        for level in range(thread, n_levels, n_threads):
            n = scatter_level(
                points, grad_features, level, scales[level], 0, mask, hashed[level], grad[thread],
                rows[thread],
            )  # fmt: skip
            first = np.uint64(offsets[level])
            for i in range(n):
                ahead = first + np.uint64(rows[thread, min(i + AHEAD, n - 1)])
                prefetch(table, ahead)
                prefetch(moments, ahead)
                row = np.uint64(rows[thread, i])
                _step_row(first + row, table, moments, row, grad[thread], rates)
