"""Adam for the hash table, and the learning-rate schedule."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vfr_bake.kernels.adam import adam_step

WARMUP_STEPS = 100
MILESTONES = (0.5, 0.75, 0.9)
DECAY = 0.33


def rate_factor(step: int, progress: float) -> float:
    """nerfacc's default schedule: linear warm-up from 1 % over 100 steps, then times 0.33 at 1/2, 3/4 and
    9/10.

    `progress` in [0, 1] is the share of the training that is done.

    >>> rate_factor(0, 0.0), rate_factor(100, 0.1), round(rate_factor(5000, 0.95), 4)
    (0.01, 1.0, 0.0359)
    """
    warm_up = min(1.0, 0.01 + 0.99 * step / WARMUP_STEPS)
    return warm_up * DECAY ** sum(progress >= milestone for milestone in MILESTONES)


class GridAdam:
    """Adam on a hash table [n_entries, 2] whose gradient is mostly zero; it owns the gradient buffer."""

    def __init__(
        self, table: Tensor, beta1: float = 0.9, beta2: float = 0.99, epsilon: float = 1e-15
    ) -> None:
        self.table = table
        table.grad = torch.zeros_like(table)
        self.mean, self.square = torch.zeros_like(table), torch.zeros_like(table)
        self.betas, self.epsilon = (beta1, beta2), epsilon
        self.n_steps = 0

    def step(self, rate: float) -> None:
        """Apply and clear the gradient."""
        self.n_steps += 1
        beta1, beta2 = self.betas
        correction = float(np.sqrt(1 - beta2**self.n_steps)) / (1 - beta1**self.n_steps)
        assert self.table.grad is not None
        arrays = (self.table.detach(), self.table.grad, self.mean, self.square)
        scalars = (rate * correction, beta1, beta2, self.epsilon)
        adam_step(*(a.numpy() for a in arrays), *(np.float32(s) for s in scalars))

    def clear(self) -> None:
        """Drop the gradient of a step that is not to be taken."""
        assert self.table.grad is not None
        self.table.grad.zero_()
