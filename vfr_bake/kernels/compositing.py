"""Compositing of per-sample features along rays, forward and backward.

Letters: a ray has the samples `start : start + count`. Sample i has the length `deltas[i]` along the ray and
the optical depth d_i = sigma_i * deltas[i]; tau_i is the sum of the depths up to and including its own. Its
transmittance is T_i = exp(-tau_{i-1}), and its weight w_i = T_i (1 - exp(-d_i)). The composite of the ray is
F = sum w_i F_i (equation 3 of the paper), and its opacity A = 1 - exp(-tau), where tau is that of its last
sample.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from vfr_bake.kernels import njit
from vfr_bake.kernels.hash_grid import FLAGS


@njit(inline="always")
def _composite_ray(ray, sigmas, features, deltas, starts, counts, weights, taus, out, opacity):
    kind = sigmas.dtype.type
    tau = kind(0)
    for c in range(out.shape[1]):
        out[ray, c] = 0
    for i in range(starts[ray], starts[ray] + counts[ray]):
        depth = sigmas[i] * deltas[i]
        weight = -np.exp(-tau) * np.expm1(-depth)
        weights[i] = weight
        tau += depth
        taus[i] = tau
        for c in range(out.shape[1]):
            out[ray, c] += weight * features[i, c]
    opacity[ray] = -np.expm1(-tau)


@njit(inline="always")
def _composite_ray_backward(
    ray, features, deltas, starts, counts, weights, taus, grad_out, grad_opacity, grad_weights, grad_sigmas,
    grad_features,
):  # fmt: skip
    kind = features.dtype.type
    first, last = starts[ray], starts[ray] + counts[ray]
    if first == last:
        return
    end = np.exp(-taus[last - 1]) * grad_opacity[ray]
    behind = kind(0)
    for i in range(last - 1, first - 1, -1):
        inner = grad_weights[i]
        for c in range(features.shape[1]):
            inner += grad_out[ray, c] * features[i, c]
            grad_features[i, c] = weights[i] * grad_out[ray, c]
        grad_sigmas[i] = deltas[i] * (np.exp(-taus[i]) * inner - behind + end)
        behind += weights[i] * inner


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def composite(sigmas, features, deltas, starts, counts, weights, taus, out, opacity):
    """Composite all rays: write w_i to `weights` and tau_i to `taus` (both [n_samples]), F to `out`
    [n_rays, n_channels] and A to `opacity` [n_rays]."""
    for ray in prange(starts.shape[0]):
        _composite_ray(ray, sigmas, features, deltas, starts, counts, weights, taus, out, opacity)


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def composite_part(sigmas, features, deltas, starts, counts, weights, taus, out, opacity):
    """Do what `composite` does, but on the calling thread alone, so that other threads can do other rays."""
    for ray in range(starts.shape[0]):
        _composite_ray(ray, sigmas, features, deltas, starts, counts, weights, taus, out, opacity)


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def composite_backward(
    features, deltas, starts, counts, weights, taus, grad_out, grad_opacity, grad_weights, grad_sigmas,
    grad_features,
):  # fmt: skip
    """Write the gradients of `composite`. With g = dL/dF, a = dL/dA and v_i = dL/dw_i + g.F_i, they are

    dL/dF_i = w_i g,    dL/d d_i = T_{i+1} v_i - sum_{j>i} w_j v_j + a exp(-tau).
    """
    for ray in prange(starts.shape[0]):
        _composite_ray_backward(
            ray, features, deltas, starts, counts, weights, taus, grad_out, grad_opacity, grad_weights,
            grad_sigmas, grad_features,
        )  # fmt: skip


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def composite_part_backward(
    features, deltas, starts, counts, weights, taus, grad_out, grad_opacity, grad_weights, grad_sigmas,
    grad_features,
):  # fmt: skip
    """Do what `composite_backward` does, but on the calling thread alone."""
    for ray in range(starts.shape[0]):
        _composite_ray_backward(
            ray, features, deltas, starts, counts, weights, taus, grad_out, grad_opacity, grad_weights,
            grad_sigmas, grad_features,
        )  # fmt: skip


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def silence(gradients, faint):
    """Set to 0 the rows of `gradients` [n_samples, n_channels] that are shorter than `faint` times the root
    mean square of all rows' lengths. If there is a NaN, nothing changes."""
    n, n_channels = gradients.shape
    kind = gradients.dtype.type
    squares = np.empty(n, gradients.dtype)
    total = kind(0)
    for i in range(n):
        square = kind(0)
        for c in range(n_channels):
            square += gradients[i, c] * gradients[i, c]
        squares[i] = square
        total += square
    least = faint * faint * (total / kind(max(n, 1)))
    for i in range(n):
        if squares[i] < least:
            for c in range(n_channels):
                gradients[i, c] = 0


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def distortion(weights, mids, widths, reach, starts, counts, losses, grad_weights):
    """Write the distortion of each ray (mip-NeRF 360, eq. 15) to `losses` and its gradient to `grad_weights`;
    intervals that are farther apart than `reach` count as `reach` apart.

    losses[r] = sum_ij w_i w_j min(|m_i - m_j|, reach) + 1/3 sum_i w_i^2 b_i for interval middles m, ascending
    along a ray, and widths b. It runs on the calling thread.
    """
    kind = weights.dtype.type
    for ray in range(starts.shape[0]):
        first, last = starts[ray], starts[ray] + counts[ray]
        total = kind(0)
        for i in range(first, last):
            total += weights[i]
        # Intervals within reach of interval i: `low` to i - 1 before it, i + 1 to `high` - 1 behind it.
        low, high = first, first
        before, before_m, after, after_m = kind(0), kind(0), kind(0), kind(0)
        loss = kind(0)
        for i in range(first, last):
            w, m, b = weights[i], mids[i], widths[i]
            while high < last and (high <= i or mids[high] - m < reach):
                after += weights[high]
                after_m += weights[high] * mids[high]
                high += 1
            while low < i and m - mids[low] >= reach:
                before -= weights[low]
                before_m -= weights[low] * mids[low]
                low += 1
            after -= w
            after_m -= w * m
            # sum_j w_j min(|m_i - m_j|, reach)
            distance = m * before - before_m + after_m - m * after + reach * (total - before - after - w)
            loss += w * distance + w * w * b / kind(3)
            grad_weights[i] = kind(2) * distance + kind(2) * w * b / kind(3)
            before += w
            before_m += w * m
        losses[ray] = loss
