"""Proposal sampling of unbounded scenes (Barron et al. 2022, sections 3 and 4), fused per ray.

Letters: t is the distance along a ray in model units, and s its spacing coordinate: s = t / 2 up to t = 1,
and 1 - 1 / (2 t) beyond, so that samples are dense near the cameras and sparse far away. `edges`
[n_rays, n + 1] are the borders of a ray's n intervals in s, and `weights` [n_rays, n] the compositing weights
of the intervals for the proposal's density. A proposal's log-density is the sum over levels of one
interpolated channel: a linear map of one-channel features whose factors are absorbed into the table.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from player.compiled.lanes import LANES
from vfr_bake.kernels import njit
from vfr_bake.kernels.density import density_logit
from vfr_bake.kernels.hash_grid import FLAGS, HashGridArrays, corners
from vfr_bake.kernels.ray_lanes import look_up_lanes, propose_lanes

PADDING = 1e-3
"""Weight that is added to every interval before samples are drawn, so that every place can be drawn."""


class Round(NamedTuple):
    """Result of one round of proposals, on n_rays rays with n intervals each."""

    edges: np.ndarray
    """[n_rays, n + 1] borders of the intervals, in s."""
    depths: np.ndarray
    """[n_rays, n] optical depth of each interval; 0 behind an opaque one."""
    points: np.ndarray
    """[n_rays, 3, n] middles of the intervals, in the unit cube; undefined behind an opaque one."""
    weights: np.ndarray
    """[n_rays, n], 0 behind an opaque interval."""


@njit(fastmath=FLAGS, error_model="numpy")
def spacing(t):
    """Return s, in [0, 1), for a distance t >= 0."""
    one = t * 0 + 1
    two = one + one
    if t < one:
        return t / two
    return one - one / (two * t)


@njit(fastmath=FLAGS, error_model="numpy")
def distance(s):
    """Return t for a spacing coordinate s in [0, 1): the inverse of `spacing`."""
    one = s * 0 + 1
    two = one + one
    if s * two < one:
        return two * s
    return one / (two * (one - s))


@njit(fastmath=FLAGS, error_model="numpy")
def resample(edges, weights, exponent, jitter, mass, middles, out):
    """Draw m intervals from a histogram with the borders `edges` [n + 1] and the `weights` [n] >= 0, and
    write their borders to `out` [m + 1].

    The middles of the new intervals are the inverse of the distribution function at (j + jitter) / m. Borders
    lie half way between middles, and are reflected at the first and the last middle (mip-NeRF 360, section
    3). Weights are raised to `exponent` in [0, 1], which flattens them while they cannot be trusted yet.
    `mass` and `middles` are scratch, of at least [n + 1] and [m + n].
    """
    kind = edges.dtype.type
    n, m = weights.shape[0], out.shape[0] - 1
    padding = kind(PADDING)
    total = kind(0)
    mass[0] = total
    for j in range(n):
        total += (weights[j] if exponent == kind(1) else weights[j] ** exponent) + padding
        mass[j + 1] = total
    low, high = edges[0], edges[n]
    part = total / kind(m)
    # Each turn goes on to the next middle or to the next interval, without a branch that could be
    # mispredicted: a middle that was computed for the wrong interval is overwritten in a later turn.
    i, j = 0, 0
    for _ in range(m + n - 1):
        wanted = (kind(i) + jitter) * part
        share = (wanted - mass[j]) / (mass[j + 1] - mass[j])
        middles[i] = edges[j] + min(max(share, kind(0)), kind(1)) * (edges[j + 1] - edges[j])
        onward = np.int64((mass[j + 1] < wanted) & (j < n - 1))
        j += onward
        i += 1 - onward
    half = kind(0.5)
    for i in range(1, m):
        out[i] = (middles[i - 1] + middles[i]) * half
    if m == 1:
        out[0], out[1] = low, high
        return
    out[0] = max(low, middles[0] - (out[1] - middles[0]))
    out[m] = min(high, middles[m - 1] + (middles[m - 1] - out[m - 1]))


@njit(fastmath=FLAGS, error_model="numpy")
def _proposal_weights(rays_o, rays_d, ray, grid, limits, found):
    """Fill in one ray's points, depths and weights in the round `found`, from its edges, which are there
    already. Once the ray is opaque, only the other intervals of the same LANES are still looked up."""
    origin, direction, edges = rays_o[ray], rays_d[ray], found.edges[ray]
    points, depths, weights = found.points[ray], found.depths[ray], found.weights[ray]
    tau = np.float32(0)
    for first in range(0, weights.shape[0], LANES):
        if tau > limits.opaque_depth:
            weights[first:] = 0
            depths[first:] = 0
            return
        tau = propose_lanes(origin, direction, edges, first, grid, limits, tau, points, depths, weights)


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def propose(rays_o, rays_d, jitter, borders, exponent, grid0, grid1, limits, first, second, edges):
    """Run two rounds of importance sampling, and write the borders of the final intervals in s to `edges`
    [n_rays, n + 1].

    `jitter` [n_rays, 3] in [0, 1) shifts the intervals of the two rounds and the final ones; 0.5 leaves them
    in the middle. `borders` are the least and the largest s. `grid0` and `grid1` are the proposals of the
    rounds `first` and `second`, which are filled in.
    """
    kind = edges.dtype.type
    near, far = borders
    block = 16
    n_rays = rays_o.shape[0]
    for start in prange((n_rays + block - 1) // block):
        most = max(edges.shape[1], first.edges.shape[1], second.edges.shape[1])
        mass, middles = np.empty(most, edges.dtype), np.empty(2 * most, edges.dtype)
        whole = np.array([near, far], edges.dtype)
        unit = np.ones(1, edges.dtype)
        for ray in range(start * block, min((start + 1) * block, n_rays)):
            shift = jitter[ray]
            resample(whole, unit, kind(1), shift[0], mass, middles, first.edges[ray])
            _proposal_weights(rays_o, rays_d, ray, grid0, limits, first)
            resample(
                first.edges[ray], first.weights[ray], exponent, shift[1], mass, middles, second.edges[ray]
            )
            _proposal_weights(rays_o, rays_d, ray, grid1, limits, second)
            resample(second.edges[ray], second.weights[ray], exponent, shift[2], mass, middles, edges[ray])


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def field_samples(rays_o, rays_d, edges, field, limits, counts, t_mid, deltas, points, features, sigmas):
    """Look the field up in the final intervals, up to where each ray is opaque. The number n of a ray's
    intervals is a multiple of LANES.

    Ray r writes its `counts[r]` samples to the rows from r * n on of `t_mid`, `deltas`, `points`, `features`
    and `sigmas`. Rows behind these samples, up to (r + 1) * n, have no meaning.
    """
    n = edges.shape[1] - 1
    block = 16
    n_rays = rays_o.shape[0]
    grid = HashGridArrays(field.table, field.scales, field.offsets, field.hashed, field.mask)
    for start in prange((n_rays + block - 1) // block):
        hidden = np.zeros(field.b1.shape[0], edges.dtype)
        places = np.empty((5, LANES), edges.dtype)
        for ray in range(start * block, min((start + 1) * block, n_rays)):
            tau = np.float32(0)
            counts[ray] = n
            for first in range(0, n, LANES):
                k = ray * n + first
                look_up_lanes(
                    rays_o[ray], rays_d[ray], edges[ray], first, grid, places, features[k : k + LANES]
                )
                for lane in range(LANES):
                    if tau > limits.opaque_depth:
                        counts[ray] = min(counts[ray], first + lane)
                    logit = density_logit(features[k + lane], field, hidden)
                    sigmas[k + lane] = np.exp(min(logit, limits.largest_logit))
                    t_mid[k + lane], deltas[k + lane] = places[0, lane], places[1, lane]
                    for axis in range(3):
                        points[k + lane, axis] = places[2 + axis, lane]
                    tau += sigmas[k + lane] * deltas[k + lane]
                if tau > limits.opaque_depth:
                    counts[ray] = min(counts[ray], first + LANES)
                    break


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def interlevel(edges, starts, counts, weights, found, losses, grad_logits):
    """Write the interlevel loss (mip-NeRF 360, eq. 13) of each ray to `losses`, and to `grad_logits` its
    gradient with respect to the log-densities of the proposal whose round is `found`.

    The final weight of an interval must not exceed the sum of the proposal's weights that overlap it:
    sum_i max(0, w_i - bound_i)^2 / w_i. Final weights are `weights[starts[r] : starts[r] + counts[r]]` on the
    intervals `edges[r]`; those of later intervals are 0.
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
    """Add to `grad_table` [n_entries, 1] the gradient of a proposal's log-densities at `points` [n_rays, 3,
    n], given `grad_logits` [n_rays, n]. Each level is owned by one thread, as in `hash_grid.scatter`."""
    scales, offsets, hashed, mask = levels
    n_levels = scales.shape[0]
    for thread in prange(n_threads):
        for level in range(thread, n_levels, n_threads):
            for ray in range(points.shape[0]):
                for j in range(points.shape[2]):
                    g = grad_logits[ray, j]
                    if g == 0:
                        continue
                    r, w = corners(
                        points[ray, 0, j], points[ray, 1, j], points[ray, 2, j], scales[level],
                        offsets[level], mask, hashed[level],
                    )  # fmt: skip
                    for corner in range(8):
                        grad_table[r[corner], 0] += w[corner] * g
