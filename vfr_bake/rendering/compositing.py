"""Compositing: F = sum w_i F_i and A = 1 - exp(-tau), on packed samples (equation 3 of the paper)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vfr_bake.field.networks import DensityNetwork
from vfr_bake.kernels import compositing as kernels
from vfr_bake.kernels.density import LARGEST_LOGIT
from vfr_bake.kernels.head.activations import relu_backward
from vfr_bake.torch_kernels.compositing import Composite


@dataclass(frozen=True)
class RaySamples:
    """Visible samples of a batch of rays."""

    t_mid: Tensor
    """[n_samples] distance along the ray in model units."""
    deltas: Tensor
    """[n_samples] length of the sample's interval in model units."""
    points: Tensor
    """[n_samples, 3] in the unit cube of the field."""
    features: Tensor
    """[n_samples, n_channels] that the march looked up."""
    rays: Tensor
    """[n_served] indices of the rays that were served; rays past the sample budget are left out."""
    starts: Tensor
    """[n_served] first sample of each of these rays."""
    counts: Tensor
    """[n_served] number of samples of each of these rays, 0 where a ray meets nothing."""
    sigmas: Tensor
    """[n_samples] densities that the march looked up."""
    trail: Any = None
    """Values about the samples that the guide of a training needs later in the step, in
    tensors and plain values."""


def composite(sigmas: Tensor, features: Tensor, deltas: Tensor, starts: Tensor, counts: Tensor) -> Composite:
    """Composite packed samples.

    `sigmas` [n_samples] are >= 0, `features` are [n_samples, n_channels], and `deltas` [n_samples] are
    lengths along the ray. Ray r owns the rows `starts[r] : starts[r] + counts[r]`. Optical depth is summed
    and exponentiated once, because a product of (1 - alpha) would lose thin samples.

    >>> one = torch.tensor([1.0])
    >>> F, A, w = composite(one, torch.ones(1, 2), one, torch.tensor([0]), torch.tensor([1]))
    >>> round(float(A[0]), 4), round(float(F[0, 0]), 4), round(float(w[0]), 4)
    (0.6321, 0.6321, 0.6321)
    """
    return Composite(*_Composite.apply(sigmas, features, deltas, starts, counts))  # type: ignore[misc]


def composite_field(
    density: DensityNetwork,
    features: Tensor,
    sigmas: Tensor,
    deltas: Tensor,
    starts: Tensor,
    counts: Tensor,
    faint: float = 0.0,
) -> Composite:
    """Composite as `composite` does, with the densities `sigmas` [n_samples] that `density` has at
    `features`, on a CPU, in float32.

    Differentiable with respect to the features and the network; `TruncatedExp` says how a saturated density
    learns. The gradient with respect to the features of a sample is set to 0 if its length is less than
    `faint` times the root mean square of all.
    """
    samples = features, sigmas, deltas, starts, counts
    return Composite(*_CompositeField.apply(*samples, faint, *density.parameters()))  # type: ignore[misc]


def distortion(
    weights: Tensor, mids: Tensor, widths: Tensor, reach: float, starts: Tensor, counts: Tensor
) -> Tensor:
    """Return the distortion [n_rays] of the weights over intervals with ascending `mids` and
    `widths` [n_samples]: sum_ij w_i w_j min(|m_i - m_j|, reach) + 1/3 sum_i w_i^2 b_i (mip-NeRF 360,
    eq. 15, which has no `reach`).

    Beyond `reach` the loss does not pull weights together, so that two surfaces behind each other,
    as those of glass, stay two. Differentiable with respect to `weights` alone. A single opaque
    interval of width b gives b / 3.

    >>> one = torch.tensor([1.0])
    >>> round(float(distortion(one, one, one, 1.0, torch.tensor([0]), torch.tensor([1]))), 4)
    0.3333
    """
    return _Distortion.apply(weights, mids, widths, reach, starts, counts)  # type: ignore[return-value]


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sigmas, features, deltas, starts, counts):
        weights, taus = torch.zeros_like(sigmas), torch.empty_like(sigmas)
        out = torch.empty(len(starts), features.shape[1], dtype=features.dtype)
        opacity = torch.empty(len(starts), dtype=features.dtype)
        kernels.composite(
            _array(sigmas), _array(features), deltas.numpy(), starts.numpy(), counts.numpy(),
            weights.numpy(), taus.numpy(), out.numpy(), opacity.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(features, deltas, starts, counts, weights, taus)
        return out, opacity, weights

    @staticmethod
    def backward(ctx, *grads):
        features, deltas, starts, counts, weights, taus = ctx.saved_tensors
        grad_out, grad_opacity, grad_weights = (_array(grad) for grad in grads)
        # Rows that belong to no ray keep these zeros; a march makes no such rows.
        grad_sigmas, grad_features = torch.zeros_like(weights), torch.zeros_like(features)
        kernels.composite_backward(
            _array(features), deltas.numpy(), starts.numpy(), counts.numpy(), weights.numpy(), taus.numpy(),
            grad_out, grad_opacity, grad_weights, grad_sigmas.numpy(), grad_features.numpy(),
        )  # fmt: skip
        return grad_sigmas, grad_features, None, None, None


class _CompositeField(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, sigmas, deltas, starts, counts, faint, *parameters):
        ctx.faint = np.float32(faint)
        sigmas = sigmas.clamp(min=float(np.exp(-LARGEST_LOGIT)))
        weights, taus = torch.zeros_like(sigmas), torch.empty_like(sigmas)
        out = features.new_empty(len(starts), features.shape[1])
        opacity = features.new_empty(len(starts))
        kernels.composite_part(
            _array(sigmas), _array(features), deltas.numpy(), starts.numpy(), counts.numpy(),
            weights.numpy(), taus.numpy(), out.numpy(), opacity.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(features, sigmas, deltas, starts, counts, weights, taus, *parameters)
        return out, opacity, weights

    @staticmethod
    def backward(ctx, *grads):
        features, sigmas, deltas, starts, counts, weights, taus, *parameters = ctx.saved_tensors
        grad_logits, grad_features = torch.zeros_like(weights), torch.zeros_like(features)
        kernels.composite_part_backward(
            _array(features), deltas.numpy(), starts.numpy(), counts.numpy(), weights.numpy(), taus.numpy(),
            *(_array(grad) for grad in grads), grad_logits.numpy(), grad_features.numpy(),
        )  # fmt: skip
        grad_logits *= sigmas
        nothing = [None] * 5
        grad_bias = grad_logits.sum().reshape(1)
        *hidden, weight, _ = parameters
        if not hidden:
            grad_weight = torch.mv(features.t(), grad_logits)[None]
            grad_features.addr_(grad_logits, weight[0])
            kernels.silence(grad_features.numpy(), ctx.faint)
            return grad_features, *nothing, grad_weight, grad_bias
        weight1, bias1 = hidden
        grad_hidden = torch.mm(features, weight1.t())
        grad_weight, grad_bias1 = torch.empty_like(weight), torch.empty_like(bias1)
        relu_backward(
            grad_hidden.numpy(), bias1.numpy(), weight.numpy()[0], grad_logits.numpy(),
            grad_weight.numpy()[0], grad_bias1.numpy(),
        )  # fmt: skip
        grad_features.addmm_(grad_hidden, weight1)
        grad_weight1 = torch.mm(grad_hidden.t(), features)
        kernels.silence(grad_features.numpy(), ctx.faint)
        return grad_features, *nothing, grad_weight1, grad_bias1, grad_weight, grad_bias


class _Distortion(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights, mids, widths, reach, starts, counts):
        losses = torch.empty(len(starts), dtype=weights.dtype)
        grad = torch.zeros_like(weights)
        kernels.distortion(
            _array(weights), mids.numpy(), widths.numpy(), mids.numpy().dtype.type(reach), starts.numpy(),
            counts.numpy(), losses.numpy(), grad.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(grad, starts, counts)
        return losses

    @staticmethod
    def backward(ctx, *grads):
        grad, starts, counts = ctx.saved_tensors
        # Samples are packed without gaps, but not in the order of the rays.
        order = torch.argsort(starts, stable=True)
        return grad * grads[0][order].repeat_interleave(counts[order]), *[None] * 5


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()
