"""Proposal sampling of unbounded scenes (Barron et al. 2022, sections 3 and 4), fused per ray.

Letters: t is the distance along a ray in model units, s its spacing coordinate: s = t / 2 up to t = 1 and 1 -
1 / (2 t) beyond, so that samples are dense near the cameras and sparse far away. `edges` [n_rays, n + 1] are
the borders of a ray's n intervals in s, `weights` [n_rays, n] what the proposal's density gives them. A
proposal's log-density is the sum over levels of one interpolated channel: a linear map of one-channel
features, absorbed into the table.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from vfr_bake.kernels import njit
from vfr_bake.kernels.contraction import contracted_at
from vfr_bake.kernels.density import look_up
from vfr_bake.kernels.hash_grid import FLAGS, corners, prefetch_point

PADDING = 1e-3
"""Weight that every interval gets before it is drawn from, so that no place is out of reach."""


class Round(NamedTuple):
    """What one round of proposals finds on n_rays rays in n intervals each."""

    edges: np.ndarray
    """[n_rays, n + 1] borders of the intervals, in s."""
    depths: np.ndarray
    """[n_rays, n] optical depth of each interval; 0 behind an opaque one."""
    points: np.ndarray
    """[n_rays, n, 3] middles of the intervals, in the unit cube; undefined behind an opaque one."""
    weights: np.ndarray
    """[n_rays, n], 0 behind an opaque interval."""


@njit(fastmath=FLAGS, error_model="numpy")
def spacing(t):
    """s of a distance t >= 0, in [0, 1)."""
    one = t * 0 + 1
    two = one + one
    if t < one:
        return t / two
    return one - one / (two * t)


@njit(fastmath=FLAGS, error_model="numpy")
def distance(s):
    """t of a spacing coordinate s in [0, 1): the inverse of `spacing`."""
    one = s * 0 + 1
    two = one + one
    if s * two < one:
        return two * s
    return one / (two * (one - s))


@njit(fastmath=FLAGS, error_model="numpy")
def proposal_logit(x, y, z, grid):
    """Log-density of a proposal at a point of the unit cube; the grid's table is [n_entries, 1]."""
    prefetch_point(x, y, z, grid)
    table, scales, offsets, hashed, mask = grid
    total = table.dtype.type(0)
    for level in range(scales.shape[0]):
        r, w = corners(x, y, z, scales[level], offsets[level], mask, hashed[level])
        total += (
            w[0] * table[r[0], 0]
            + w[1] * table[r[1], 0]
            + w[2] * table[r[2], 0]
            + w[3] * table[r[3], 0]
            + w[4] * table[r[4], 0]
            + w[5] * table[r[5], 0]
            + w[6] * table[r[6], 0]
            + w[7] * table[r[7], 0]
        )
    return total


@njit(fastmath=FLAGS, error_model="numpy")
def resample(edges, weights, exponent, jitter, centres, out):
    """Borders `out` [m + 1] of m intervals drawn from a histogram: `edges` [n + 1], `weights` [n] >= 0.

    The middles are the inverse of the distribution function at (j + jitter) / m; borders lie half way between
    middles and are reflected at both ends (mip-NeRF 360, section 3). `centres` [m] is scratch. Weights are
    raised to `exponent` in [0, 1], which flattens them while they are not to be trusted yet.
    """
    kind = edges.dtype.type
    n, m = weights.shape[0], out.shape[0] - 1
    padding = kind(PADDING)
    total = kind(0)
    for j in range(n):
        total += (weights[j] if exponent == kind(1) else weights[j] ** exponent) + padding
    low, high = edges[0], edges[n]
    j = -1
    before, inside = kind(0), kind(0)
    for i in range(m):
        wanted = (kind(i) + jitter) / kind(m) * total
        while j < n - 1 and (j < 0 or before + inside < wanted):
            before += inside
            j += 1
            inside = (weights[j] if exponent == kind(1) else weights[j] ** exponent) + padding
        share = min(max((wanted - before) / inside, kind(0)), kind(1))
        centres[i] = edges[j] + share * (edges[j + 1] - edges[j])
    half = kind(0.5)
    for i in range(1, m):
        out[i] = (centres[i - 1] + centres[i]) * half
    if m == 1:
        out[0], out[1] = low, high
        return
    out[0] = max(low, centres[0] - (out[1] - centres[0]))
    out[m] = min(high, centres[m - 1] + (centres[m - 1] - out[m - 1]))


@njit(fastmath=FLAGS, error_model="numpy")
def _proposal_weights(rays_o, rays_d, ray, grid, limits, found):
    """Fill in what the round `found` has of one ray, whose edges are there; nothing is looked up behind an
    opaque interval."""
    edges, depths, points, weights = (
        found.edges[ray], found.depths[ray], found.points[ray], found.weights[ray]
    )  # fmt: skip
    kind = edges.dtype.type
    half = kind(0.5)
    tau = kind(0)
    t0 = distance(edges[0])
    for j in range(weights.shape[0]):
        if tau > limits.opaque_depth:
            weights[j] = 0
            depths[j] = 0
            continue
        t1 = distance(edges[j + 1])
        t = (t0 + t1) * half
        x, y, z = contracted_at(rays_o, rays_d, ray, t)
        logit = min(proposal_logit(x, y, z, grid), limits.largest_logit)
        depth = np.exp(logit) * (t1 - t0)
        weights[j] = -np.exp(-tau) * np.expm1(-depth)
        tau += depth
        depths[j] = depth
        points[j, 0], points[j, 1], points[j, 2] = x, y, z
        t0 = t1


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def propose(rays_o, rays_d, jitter, borders, exponent, grid0, grid1, limits, first, second, edges):
    """Two rounds of importance sampling: `edges` [n_rays, n + 1] of the final intervals in s.

    `jitter` [n_rays, 3] in [0, 1) shifts the intervals of each round, 0.5 everywhere leaves them in the
    middle; `borders` are the least and the largest s, `grid0` and `grid1` the proposals of the rounds
    `first` and `second`, which are filled in.
    """
    kind = edges.dtype.type
    near, far = borders
    block = 16
    n_rays = rays_o.shape[0]
    for start in prange((n_rays + block - 1) // block):
        centres = np.empty(max(edges.shape[1], second.edges.shape[1]), edges.dtype)
        whole = np.array([near, far], edges.dtype)
        unit = np.ones(1, edges.dtype)
        for ray in range(start * block, min((start + 1) * block, n_rays)):
            shift = jitter[ray]
            resample(whole, unit, kind(1), shift[0], centres, first.edges[ray])
            _proposal_weights(rays_o, rays_d, ray, grid0, limits, first)
            resample(first.edges[ray], first.weights[ray], exponent, shift[1], centres, second.edges[ray])
            _proposal_weights(rays_o, rays_d, ray, grid1, limits, second)
            resample(second.edges[ray], second.weights[ray], exponent, shift[2], centres, edges[ray])


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def field_samples(rays_o, rays_d, edges, field, limits, counts, t_mid, deltas, points, features):
    """Look the field up in the final intervals, up to where a ray is opaque.

    Ray r writes its `counts[r]` samples to the rows from r * n on of `t_mid`, `deltas`, `points` and
    `features`; the rows behind them are left as they are.
    """
    kind = edges.dtype.type
    half = kind(0.5)
    n = edges.shape[1] - 1
    block = 16
    n_rays = rays_o.shape[0]
    for start in prange((n_rays + block - 1) // block):
        hidden = np.zeros(field.b1.shape[0], edges.dtype)
        for ray in range(start * block, min((start + 1) * block, n_rays)):
            tau = kind(0)
            t0 = distance(edges[ray, 0])
            counts[ray] = 0
            for j in range(n):
                if tau > limits.opaque_depth:
                    break
                t1 = distance(edges[ray, j + 1])
                t = (t0 + t1) * half
                k = ray * n + j
                x, y, z = contracted_at(rays_o, rays_d, ray, t)
                sigma = look_up(x, y, z, field, limits, features[k], hidden)
                t_mid[k] = t
                deltas[k] = t1 - t0
                points[k, 0], points[k, 1], points[k, 2] = x, y, z
                tau += sigma * (t1 - t0)
                counts[ray] = j + 1
                t0 = t1


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def interlevel(edges, starts, counts, weights, found, losses, grad_logits):
    """Interlevel loss (mip-NeRF 360, eq. 13) of each ray and its gradient for the log-densities of the
    proposal whose round is `found`.

    The final weight of an interval must not exceed the sum of the proposal's weights that overlap it:
    sum_i max(0, w_i - bound_i)^2 / w_i. Final weights are `weights[starts[r] : starts[r] + counts[r]]` on the
    intervals `edges[r]`, those behind counts[r] being 0.
    """
    kind = edges.dtype.type
    least = kind(1e-7)
    proposal_edges, depths, _, proposal_weights = found
    n = proposal_weights.shape[1]
    for ray in prange(edges.shape[0]):
        grad = grad_logits[ray]
        for j in range(n):
            grad[j] = 0
        first = 0
        loss = kind(0)
        for i in range(counts[ray]):
            low, high = edges[ray, i], edges[ray, i + 1]
            while first < n - 1 and proposal_edges[ray, first + 1] <= low:
                first += 1
            bound = kind(0)
            j = first
            while j < n and proposal_edges[ray, j] < high:
                bound += proposal_weights[ray, j]
                j += 1
            w = weights[starts[ray] + i]
            excess = w - bound
            if excess > 0:
                loss += excess * excess / (w + least)
                slope = kind(-2) * excess / (w + least)
                for k in range(first, j):
                    grad[k] += slope
        losses[ray] = loss
        # From weights to log-densities: dL/d log sigma_j = d_j (T_{j+1} v_j - sum_{k>j} w_k v_k), v = dL/dw.
        tau, behind = kind(0), kind(0)
        for j in range(n):
            behind += proposal_weights[ray, j] * grad[j]
        for j in range(n):
            behind -= proposal_weights[ray, j] * grad[j]
            tau += depths[ray, j]
            grad[j] = depths[ray, j] * (np.exp(-tau) * grad[j] - behind)


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def scatter_logits(points, grad_logits, levels, n_threads, grad_table):
    """Add to `grad_table` [n_entries, 1] the gradient of `proposal_logit` at `points` [n_points, 3], given
    `grad_logits` [n_points]. One thread owns a level, as in the hash grid's own scatter."""
    scales, offsets, hashed, mask = levels
    n_levels = scales.shape[0]
    for thread in prange(n_threads):
        for level in range(thread, n_levels, n_threads):
            for i in range(points.shape[0]):
                if grad_logits[i] == 0:
                    continue
                r, w = corners(
                    points[i, 0], points[i, 1], points[i, 2], scales[level], offsets[level], mask,
                    hashed[level],
                )  # fmt: skip
                for corner in range(8):
                    grad_table[r[corner], 0] += w[corner] * grad_logits[i]
