"""Proposal sampling of unbounded scenes in torch (Barron et al. 2022, sections 3 and 4), all rays at once.

Letters as in `vfr_bake.kernels.proposals`: s = t / 2 up to t = 1 and 1 - 1 / (2 t) beyond.
"""

from __future__ import annotations

import torch
from torch import Tensor

from player.march.march import OPAQUE_DEPTH
from vfr_bake.kernels.density import LARGEST_LOGIT
from vfr_bake.kernels.proposals import PADDING
from vfr_bake.torch_kernels.compositing import sums_before


def distance(s: Tensor) -> Tensor:
    """Return t for spacing coordinates s in [0, 1).

    >>> distance(torch.tensor([0.25, 0.5, 0.75])).tolist()
    [0.5, 1.0, 2.0]
    """
    return torch.where(2 * s < 1, 2 * s, 1 / (2 * (1 - s)))


def contracted_unit(points: Tensor) -> Tensor:
    """Return the points [..., 3] of the unit cube for any finite `points` of the model frame (eq. 10).

    >>> contracted_unit(torch.tensor([[1e30, 0.0, 0.0], [0.5, 0.0, -0.5]])).tolist()
    [[1.0, 0.5, 0.5], [0.625, 0.5, 0.375]]
    """
    # Divide by the largest coordinate first: the square of 1e30 would overflow float32.
    largest = points.abs().amax(dim=-1, keepdim=True).clamp(min=0.5)
    norm = largest * torch.linalg.vector_norm(points / largest, dim=-1, keepdim=True)
    scale = torch.where(norm > 1, (2 - 1 / norm) / norm, torch.ones_like(norm))
    return points * (scale / 4) + 0.5


def resample(edges: Tensor, weights: Tensor, exponent: float, jitter: Tensor, n: int) -> Tensor:
    """Draw n intervals per ray from histograms with the borders `edges` [n_rays, m + 1] and the `weights`
    [n_rays, m] >= 0, shifted by `jitter` [n_rays] in [0, 1); return their borders [n_rays, n + 1]."""
    mass = weights**exponent + PADDING
    up_to = torch.cumsum(mass, dim=1)
    numbers = torch.arange(n, device=edges.device)
    wanted = (numbers + jitter[:, None]) / n * up_to[:, -1:]
    j = torch.searchsorted(up_to, wanted).clamp(max=weights.shape[1] - 1)
    inside = mass.gather(1, j)
    share = ((wanted - sums_before(mass).gather(1, j)) / inside).clamp(0, 1)
    centres = torch.lerp(edges.gather(1, j), edges.gather(1, j + 1), share)
    low, high = edges[:, :1], edges[:, -1:]
    if n == 1:
        return torch.cat([low, high], dim=1)
    inner = (centres[:, 1:] + centres[:, :-1]) / 2
    first = torch.maximum(low, 2 * centres[:, :1] - inner[:, :1])
    last = torch.minimum(high, 2 * centres[:, -1:] - inner[:, -1:])
    return torch.cat([first, inner, last], dim=1)


def midpoints(rays_o: Tensor, rays_d: Tensor, edges: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return t [n_rays, n], lengths [n_rays, n] and points of the unit cube [n_rays, n, 3] for the intervals
    with the borders `edges` [n_rays, n + 1]; t and the points are those of their middles."""
    t = distance(edges)
    middle = (t[:, :-1] + t[:, 1:]) / 2
    points = rays_o[:, None] + middle[..., None] * rays_d[:, None]
    return middle, t[:, 1:] - t[:, :-1], contracted_unit(points)


def weights_of(logits: Tensor, lengths: Tensor) -> Tensor:
    """Return the weights [n_rays, n] of intervals with the log-densities `logits` and the `lengths`
    [n_rays, n]; they are 0 behind an opaque interval. Differentiable with respect to the logits."""
    # The value is clamped, and the gradient is that of the clamped density everywhere, so that a saturated
    # density can come down. The value of the bracket is 0; it adds the gradient alone.
    sigmas = torch.exp(logits.detach().clamp(max=LARGEST_LOGIT))
    depths = (sigmas + sigmas * (logits - logits.detach())) * lengths
    before = sums_before(depths)
    weights = torch.exp(-before) * -torch.expm1(-depths)
    return torch.where(before <= OPAQUE_DEPTH, weights, torch.zeros_like(weights))


def interlevel(edges: Tensor, weights: Tensor, proposal_edges: Tensor, proposal_weights: Tensor) -> Tensor:
    """Return the interlevel loss [n_rays] (mip-NeRF 360, eq. 13): sum_i max(0, w_i - bound_i)^2 / w_i for the
    final `weights` [n_rays, m] on `edges` [n_rays, m + 1], where bound_i is the sum of the proposal's weights
    [n_rays, n] that overlap interval i. Differentiable with respect to the proposal's weights."""
    n = proposal_weights.shape[1]
    low, high = edges[:, :-1].contiguous(), edges[:, 1:].contiguous()
    first = torch.searchsorted(proposal_edges[:, 1:].contiguous(), low, right=True).clamp(max=n - 1)
    end = torch.searchsorted(proposal_edges[:, :-1].contiguous(), high)
    up_to = torch.nn.functional.pad(torch.cumsum(proposal_weights, dim=1), (1, 0))
    bound = up_to.gather(1, torch.maximum(end, first)) - up_to.gather(1, first)
    excess = (weights - bound).clamp(min=0)
    return (excess * excess / (weights + 1e-7)).sum(dim=1)
