"""Muon, an optimiser for small dense networks: every matrix moves by its gradient made orthogonal, so that it
learns equally fast in all directions of its space, including those of small gradients (Jordan et al. 2024,
https://kellerjordan.github.io/posts/muon/).

With the momentum M of a matrix's gradient G, the step is the orthogonal matrix nearest to G + MOMENTUM M,
found by five Newton-Schulz iterations. It is scaled so that the root mean square of the entries' moves is
about the learning rate, as with Adam, so that both use the same rate. Biases and narrow matrices are left to
Adam, because little of their gradient would be left if it were made orthogonal.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from vfr_bake.training.optimiser import Adam

MOMENTUM = 0.95
DECAY = 0.3
"""Weight decay: in a step, a matrix shrinks by this share times the learning rate. Without it, directions of
no use stay as large as they once became: the head learns less, and its activations lose more in 8 bits."""
NARROWEST = 9
"""Fewest rows and columns of a matrix whose gradient is made orthogonal."""
COEFFICIENTS = 3.4445, -4.7750, 2.0315
"""Jordan's coefficients: N_ITERATIONS bring singular values from 0.001 to 1 to between 0.7 and 1.2."""
N_ITERATIONS = 5


class Muon:
    """Muon for the matrices of a network, Adam for its other parameters."""

    def __init__(self, parameters: Iterable[Tensor]) -> None:
        """`parameters`: matrices [n_in, n_out] and vectors; their `grad` is read in each step."""
        every = list(parameters)
        matrices = [p for p in every if p.ndim == 2 and min(p.shape) >= NARROWEST]
        shapes = dict.fromkeys(p.shape for p in matrices)
        self._groups = [[p for p in matrices if p.shape == shape] for shape in shapes]
        self._momenta = [torch.zeros(len(group), *group[0].shape) for group in self._groups]
        of_groups = {id(p) for p in matrices}
        self._adam = Adam(p for p in every if id(p) not in of_groups)

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Take one step with all parameters, and clear the gradients."""
        self._adam.step(rate)
        self._adam.clear()
        for group, momentum in zip(self._groups, self._momenta, strict=True):
            gradients = torch.stack([_gradient(p) for p in group])
            momentum.mul_(MOMENTUM).add_(gradients)
            moves = orthogonal(gradients.add_(momentum, alpha=MOMENTUM))
            moves *= rate * max(group[0].shape) ** 0.5
            for p, move in zip(group, moves, strict=True):
                p.mul_(1 - DECAY * rate).sub_(move)
                p.grad = None


def _gradient(parameter: Tensor) -> Tensor:
    assert parameter.grad is not None
    return parameter.grad


def orthogonal(matrices: Tensor) -> Tensor:
    """Return [n, n_rows, n_columns]: about U V^T of the singular value decomposition U S V^T of each of
    `matrices`; 0 stays 0.

    >>> found = orthogonal(torch.tensor([[[3.0, 0.0], [0.0, -0.01]]]))
    >>> bool((found.abs().diagonal(dim1=1, dim2=2) > 0.6).all()), float(found[0, 0, 1])
    (True, 0.0)
    """
    a, b, c = COEFFICIENTS
    x = matrices / matrices.norm(dim=(1, 2), keepdim=True).clamp_min(1e-30)
    tall = x.shape[1] > x.shape[2]
    x = x.mT if tall else x
    for _ in range(N_ITERATIONS):
        square = torch.bmm(x, x.mT)
        x = torch.baddbmm(x, torch.baddbmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return x.mT if tall else x
