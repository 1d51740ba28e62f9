"""Adam on the hash table (Kingma & Ba 2015, algorithm 1), for entries that received a gradient in this
step."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from vfr_bake.kernels.hash_grid import FLAGS


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def adam_step(table, grad, mean, square, rate, beta1, beta2, epsilon):
    """One step in place on rows [n_entries, 2] with a non-zero gradient, which is cleared; `rate` is
    bias-corrected.

    A step touches a few percent of the entries; the others keep their moments, as in instant-ngp.
    """
    kind = table.dtype.type
    one = kind(1)
    for row in prange(table.shape[0]):
        if grad[row, 0] != 0 or grad[row, 1] != 0:
            for c in range(2):
                g = grad[row, c]
                m = beta1 * mean[row, c] + (one - beta1) * g
                v = beta2 * square[row, c] + (one - beta2) * g * g
                mean[row, c] = m
                square[row, c] = v
                table[row, c] -= rate * m / (np.sqrt(v) + epsilon)
                grad[row, c] = 0
