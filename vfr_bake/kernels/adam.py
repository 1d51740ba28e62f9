"""Adam on a hash table (Kingma & Ba 2015, algorithm 1), for entries that received a gradient in this
step."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from vfr_bake.kernels.hash_grid import FLAGS


@njit(inline="always")
def _step_row(row, table, grad, moments, rate, beta1, beta2, epsilon):
    """One step of `table[row]`, if its gradient is not zero, which is cleared; `moments[row]` holds the means
    of the gradient and behind them those of its square."""
    kind = table.dtype.type
    one = kind(1)
    n = table.shape[1]
    touched = False
    for c in range(n):
        touched |= grad[row, c] != 0
    if touched:
        for c in range(n):
            g = grad[row, c]
            m = beta1 * moments[row, c] + (one - beta1) * g
            v = beta2 * moments[row, n + c] + (one - beta2) * g * g
            moments[row, c] = m
            moments[row, n + c] = v
            table[row, c] -= rate * m / (np.sqrt(v) + epsilon)
            grad[row, c] = 0


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def adam_step(table, grad, moments, rate, beta1, beta2, epsilon):
    """One step in place on all rows of `table` [n_entries, n_channels] with a gradient, which is cleared;
    `moments` [n_entries, 2 * n_channels], `rate` is bias-corrected.

    A step touches a few percent of the entries; the others keep their moments, as in instant-ngp.
    """
    for row in prange(table.shape[0]):
        _step_row(row, table, grad, moments, rate, beta1, beta2, epsilon)


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def adam_step_rows(rows, counts, n_threads, table, grad, moments, rate, beta1, beta2, epsilon):
    """The same where the touched rows are known: `rows[level, : counts[level]]`, no row in two levels.

    A row listed twice has no gradient left the second time.
    """
    for thread in prange(n_threads):
        for level in range(thread, counts.shape[0], n_threads):
            for i in range(counts[level]):
                _step_row(rows[level, i], table, grad, moments, rate, beta1, beta2, epsilon)
