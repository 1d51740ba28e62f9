"""Compositing of per-sample features along rays, forward and backward.

Letters: samples `start : start + count` of a ray, delta_i = sigma_i * step, tau_i its running sum, T_i =
exp(-tau_{i-1}), w_i = T_i (1 - exp(-delta_i)), F = sum w_i F_i (equation 3 of the paper), A = 1 - exp(-tau).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from vfr_bake.kernels.hash_grid import FLAGS


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def composite(sigmas, features, starts, counts, step, weights, taus, out, opacity):
    """Write w_i to `weights`, the optical depth behind sample i to `taus` (both [n_samples]), F to `out`
    [n_rays, n_channels] and A to `opacity` [n_rays]."""
    kind = sigmas.dtype.type
    for ray in prange(starts.shape[0]):
        tau = kind(0)
        for c in range(out.shape[1]):
            out[ray, c] = 0
        for i in range(starts[ray], starts[ray] + counts[ray]):
            delta = sigmas[i] * step
            weight = -np.exp(-tau) * np.expm1(-delta)
            weights[i] = weight
            tau += delta
            taus[i] = tau
            for c in range(out.shape[1]):
                out[ray, c] += weight * features[i, c]
        opacity[ray] = -np.expm1(-tau)


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def composite_backward(
    features, starts, counts, step, weights, taus, grad_out, grad_opacity, grad_sigmas, grad_features
):
    """Gradients of `composite`: with g = dL/dF and a = dL/dA,

    dL/dF_i = w_i g,    dL/d delta_i = T_{i+1} g.F_i - sum_{j>i} w_j g.F_j + a exp(-tau).
    """
    kind = features.dtype.type
    for ray in prange(starts.shape[0]):
        first, last = starts[ray], starts[ray] + counts[ray]
        if first == last:
            continue
        end = np.exp(-taus[last - 1]) * grad_opacity[ray]
        behind = kind(0)
        for i in range(last - 1, first - 1, -1):
            inner = kind(0)
            for c in range(features.shape[1]):
                inner += grad_out[ray, c] * features[i, c]
                grad_features[i, c] = weights[i] * grad_out[ray, c]
            grad_sigmas[i] = step * (np.exp(-taus[i]) * inner - behind + end)
            behind += weights[i] * inner
