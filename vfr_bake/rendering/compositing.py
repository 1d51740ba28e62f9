"""Compositing: F = sum w_i F_i and A = 1 - exp(-tau), on packed samples (equation 3 of the paper)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vfr_bake.kernels import compositing as kernels


def composite(
    sigmas: Tensor, features: Tensor, starts: Tensor, counts: Tensor, step: float
) -> tuple[Tensor, Tensor]:
    """Composited features [n_rays, n_channels] and opacity [n_rays].

    `sigmas` [n_samples] >= 0, `features` [n_samples, n_channels]; ray r owns the rows `starts[r] : starts[r]
    + counts[r]`. Optical depth is accumulated and exponentiated once; a product of (1 - alpha) would lose
    thin samples.

    >>> F, A = composite(torch.tensor([1.0]), torch.ones(1, 2), torch.tensor([0]), torch.tensor([1]), 1.0)
    >>> round(float(A[0]), 4), round(float(F[0, 0]), 4)
    (0.6321, 0.6321)
    """
    return _Composite.apply(sigmas, features, starts, counts, step)  # type: ignore[return-value]


def composite_reference(
    sigmas: Tensor, features: Tensor, starts: Tensor, counts: Tensor, step: float
) -> tuple[Tensor, Tensor]:
    """The same ray by ray in plain torch."""
    out, opacity = [], []
    for start, count in zip(starts.tolist(), counts.tolist(), strict=True):
        delta = sigmas[start : start + count] * step
        # The optical depth in front of each sample; a difference of sums would cancel behind a dense one.
        before = torch.cumsum(torch.cat([delta.new_zeros(1), delta]), dim=0)[:-1]
        weights = torch.exp(-before) * -torch.expm1(-delta)
        out.append((weights[:, None] * features[start : start + count]).sum(dim=0))
        opacity.append(-torch.expm1(-delta.sum()))
    return torch.stack(out), torch.stack(opacity)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sigmas, features, starts, counts, step):
        kind = sigmas.detach().numpy().dtype.type
        weights, taus = torch.empty_like(sigmas), torch.empty_like(sigmas)
        out = torch.empty(len(starts), features.shape[1], dtype=features.dtype)
        opacity = torch.empty(len(starts), dtype=features.dtype)
        kernels.composite(
            _array(sigmas), _array(features), starts.numpy(), counts.numpy(), kind(step),
            weights.numpy(), taus.numpy(), out.numpy(), opacity.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(features, starts, counts, weights, taus)
        ctx.step = kind(step)
        return out, opacity

    @staticmethod
    def backward(ctx, *grads):
        features, starts, counts, weights, taus = ctx.saved_tensors
        # Rows that belong to no ray (there are none in a march) would keep this zero.
        grad_sigmas, grad_features = torch.zeros_like(weights), torch.zeros_like(features)
        kernels.composite_backward(
            _array(features), starts.numpy(), counts.numpy(), ctx.step, weights.numpy(), taus.numpy(),
            _array(grads[0]), _array(grads[1]), grad_sigmas.numpy(), grad_features.numpy(),
        )  # fmt: skip
        return grad_sigmas, grad_features, None, None, None


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()
