"""Density of a sample from its feature (section 4 of the paper): sigma = exp(w2 . relu(w1 F + b1) + b2)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from vfr_bake.config import FieldConfig
from vfr_bake.field.initialisation import initialise

LARGEST_LOGIT = 15.0
"""Pre-activations are clamped here: exp(15) = 3e6 per model unit is opaque in one step at any step length in
use."""


class TruncatedExp(torch.autograd.Function):
    """exp(x) with x clamped to [-15, 15], with the gradient of the clamped value everywhere, so that a
    saturated density can come down and one that vanished can come back."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        y = x.clamp(-LARGEST_LOGIT, LARGEST_LOGIT).exp()
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx, *grads: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return grads[0] * y


class DensityNetwork(nn.Module):
    """One hidden layer, or a linear map where `width` is 0; float32 always.

    >>> DensityNetwork(8, 16)(torch.zeros(3, 8)).shape
    torch.Size([3])
    """

    def __init__(self, n_channels: int, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(n_channels, width) if width else None
        self.out = nn.Linear(width or n_channels, 1)
        nn.init.zeros_(self.out.bias)
        if self.hidden is not None:
            initialise([self.hidden])

    def logits(self, features: Tensor) -> Tensor:
        """Pre-activation [n] of the density at `features` [n, n_channels]."""
        if self.hidden is not None:
            features = torch.relu(self.hidden(features))
        return self.out(features)[:, 0]

    def forward(self, features: Tensor) -> Tensor:
        """Density [n] in 1/model unit."""
        return TruncatedExp.apply(self.logits(features))  # type: ignore[return-value]

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.floating]:
        """(w1 [n_channels, width], b1, w2, b2) as the kernels take them; w1 is empty for a linear map."""
        w2 = self.out.weight.detach().numpy()[0]
        b2 = self.out.bias.detach().numpy()[0]
        if self.hidden is None:
            return np.zeros((0, 0), w2.dtype), np.zeros(0, w2.dtype), w2, b2
        w1 = np.ascontiguousarray(self.hidden.weight.detach().numpy().T)
        return w1, self.hidden.bias.detach().numpy(), w2, b2


def make_density(config: FieldConfig) -> DensityNetwork:
    return DensityNetwork(config.n_channels, config.density_width)
