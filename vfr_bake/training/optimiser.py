"""Adam, for networks and for the hash table, and the learning-rate schedule."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor
from torch.optim.adam import adam

from vfr_bake.field.hash_grid import HashGrid, zeros
from vfr_bake.kernels.adam import AdamRates, adam_step, scatter_and_step

BETAS, EPSILON = (0.9, 0.99), 1e-15
"""Adam's decay rates, and what is added to its denominator; both as in instant-ngp."""
GRID_BETAS = 0.9, 0.95
"""Adam's decay rates for hash grids. Unlike networks, they learn more with a shorter memory of squared
gradients (docs/notes/2026-11-25-learning-rates.md)."""
DENSITY_DECAY = 0.05
"""Decoupled weight decay (Loshchilov and Hutter, ICLR 2019) of an unbounded scene's density network: in a
step, its matrices shrink by this share times the learning rate. Without it they keep growing, and a step of
the grid changes densities more and more, until after some 20,000 steps the geometry falls apart. Objects stay
stable without it, and learn a little more (docs/notes/2026-11-29-densities-that-steepen.md)."""
WARMUP_STEPS = 100
HELD = 0.5
"""Share of a training, from its beginning, during which the learning rate is not lowered."""


def rate_factor(step: int, progress: float) -> float:
    """Return the factor of the learning rates: a linear warm-up from 1 % over 100 steps, 1 for the first half
    of the training, then a linear fall to 0.

    `progress` in [0, 1] is the share of the training that is done.

    >>> rate_factor(0, 0.0), rate_factor(100, 0.1), rate_factor(5000, 0.75)
    (0.01, 1.0, 0.5)
    """
    warm_up = min(1.0, 0.01 + 0.99 * step / WARMUP_STEPS)
    return warm_up * min(1.0, (1 - progress) / (1 - HELD))


@torch.no_grad()
def shrink(tensors: Iterable[Tensor], share: float) -> None:
    """Shrink every entry by a `share` from 0 to 1, in place.

    >>> weight = torch.tensor([4.0, -2.0])
    >>> shrink([weight], 0.5)
    >>> weight.tolist()
    [2.0, -1.0]
    """
    for tensor in tensors:
        tensor.mul_(1 - share)


class Adam:
    """Adam (Kingma and Ba, ICLR 2015) for tensors with a `grad`. A tensor without a gradient stays as it is,
    and the step is not counted for it.

    The step itself is torch's function `adam`. The class `torch.optim.Adam` is not used: it imports torch's
    compiler when it is first made, which adds three seconds to every start, and its overhead for a step of a
    small network is longer than the step.

    >>> weight = torch.ones(3)
    >>> weight.grad = torch.tensor([1.0, -2.0, 0.0])
    >>> Adam([weight]).step(0.1)
    >>> [round(x, 6) for x in weight.tolist()]  # moved by the rate, whatever the size of the gradient
    [0.9, 1.1, 1.0]
    """

    def __init__(
        self, parameters: Iterable[Tensor], betas: tuple[float, float] = (0.9, 0.999), epsilon: float = 1e-8
    ) -> None:
        self._parameters = list(parameters)
        self._betas, self._epsilon = betas, epsilon
        self._means = [torch.zeros_like(p) for p in self._parameters]
        self._squares = [torch.zeros_like(p) for p in self._parameters]
        self._counts = [torch.zeros((), device=p.device) for p in self._parameters]

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Take one step with all tensors that have a gradient."""
        of_step = zip(self._parameters, self._means, self._squares, self._counts, strict=True)
        moved = [(p, p.grad, *moments) for p, *moments in of_step if p.grad is not None]
        if not moved:
            return
        parameters, gradients, means, squares, counts = map(list, zip(*moved, strict=True))
        adam(
            parameters, gradients, means, squares, [], counts, fused=True, amsgrad=False, lr=rate,
            beta1=self._betas[0], beta2=self._betas[1], eps=self._epsilon, weight_decay=0.0, maximize=False,
        )  # fmt: skip

    def clear(self) -> None:
        """Drop the gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    def state(self) -> dict[str, Any]:
        """Return all that later steps depend on, as tensors."""
        return {"means": self._means, "squares": self._squares, "counts": self._counts}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned. Raises ValueError or RuntimeError if that was of other
        tensors."""
        for name, tensors in self.state().items():
            for tensor, of_state in zip(tensors, state[name], strict=True):
                if tensor.shape != of_state.shape:
                    raise ValueError(f"expected {list(tensor.shape)}, got {list(of_state.shape)}")
                tensor.copy_(of_state)


class DeviceGridAdam(Adam):
    """torch's Adam for a hash table on a GPU, whose memory is fast enough to step all entries.

    Unlike with `GridAdam`, entries without a gradient therefore keep moving by their momentum for some steps.
    """

    def __init__(self, table: Tensor) -> None:
        super().__init__([table], GRID_BETAS, EPSILON)
        self.table = table

    @property
    def gradient(self) -> Tensor:
        """[n_entries, n_channels]: the gradient for the next step."""
        assert self.table.grad is not None
        return self.table.grad

    def step(self, rate: float) -> None:
        """Take one step along the gradient, and drop it."""
        super().step(rate)
        self.clear()


class GridAdam:
    """Adam for a hash table [n_entries, n_channels] whose gradient is mostly zero; it owns the buffer of the
    gradient."""

    def __init__(self, table: Tensor) -> None:
        self.table = table
        table.grad = zeros(*table.shape)
        self.moments = zeros(len(table), 2 * table.shape[1])
        self.n_steps = 0

    @property
    def gradient(self) -> Tensor:
        """[n_entries, n_channels]: the gradient for the next step."""
        assert self.table.grad is not None
        return self.table.grad

    def step(self, rate: float) -> None:
        """Take one step along the gradient, and clear it."""
        arrays = (a.numpy() for a in (self.table.detach(), self.gradient, self.moments))
        adam_step(*arrays, self._next_rates(rate))

    def clear(self) -> None:
        """Clear the gradient without taking a step."""
        self.gradient.zero_()

    def _next_rates(self, rate: float) -> AdamRates:
        """Count a step, and return its rate and decay rates."""
        self.n_steps += 1
        beta1, beta2 = GRID_BETAS
        correction = float(np.sqrt(1 - beta2**self.n_steps)) / (1 - beta1**self.n_steps)
        return AdamRates(*map(np.float32, (rate * correction, beta1, beta2, EPSILON)))

    def state(self) -> dict[str, Any]:
        """Return all that later steps depend on, as tensors and plain values."""
        return {"moments": self.moments, "n_steps": self.n_steps}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned."""
        self.moments.copy_(state["moments"])
        self.n_steps = state["n_steps"]


class FusedGridAdam(GridAdam):
    """Faster `GridAdam` for the table of a `HashGrid`, without a gradient of the whole table.

    The grid appends the points and gradients of a step to `grid.pending`. The step adds them up and applies
    them level by level.
    """

    def __init__(self, grid: HashGrid) -> None:
        assert isinstance(grid.table, Tensor)
        super().__init__(grid.table)
        self.table.grad = None
        self._grid = grid
        self._pending: list[tuple[Tensor, Tensor]] = []
        grid.pending = self._pending
        self._buffer = zeros(get_num_threads(), int(np.diff(grid.layout.offsets).max()), self.table.shape[1])
        self._rows = np.empty((get_num_threads(), 0), np.uint32)

    def step(self, rate: float) -> None:
        if not self._pending:
            return
        points, gradient = (torch.cat(parts) for parts in zip(*self._pending, strict=True))
        some = gradient.any(dim=1)
        points, gradient = points[some], gradient[some]
        if self._rows.shape[1] < 8 * len(points) + 1:
            self._rows = np.empty((get_num_threads(), 8 * len(points) + 1), np.uint32)
        scatter_and_step(
            points.numpy(), gradient.numpy(), self._grid.layout.grid(self.table), self._buffer.numpy(),
            self._rows, self.moments.numpy(), self._next_rates(rate),
        )  # fmt: skip
        self._pending.clear()

    def clear(self) -> None:
        self._pending.clear()


TableAdam = GridAdam | DeviceGridAdam
"""Adam for a hash table. Others add to the table's gradient until the step."""
