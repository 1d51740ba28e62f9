"""Muon, an optimiser of small dense networks: every matrix moves by its gradient made orthogonal, so that it
learns in all directions of its space alike, those of small gradients too (Jordan et al. 2024,
https://kellerjordan.github.io/posts/muon/).

With the momentum M of a matrix's gradient G, the step is that of the nearest orthogonal matrix to
G + MOMENTUM M, found by five Newton-Schulz iterations. It is scaled so that the entries move by about the
rate in root mean square, as those that Adam moves do: both take one learning rate. Biases and narrow
matrices, of which little would be left if they were orthogonal, are left to Adam.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from vfr_bake.training.optimiser import Adam

MOMENTUM = 0.95
DECAY = 0.3
"""By so many times the rate a matrix shrinks in a step. Directions of no use would else stay as large as they
became: a head that is not held learns less, and 8 bits of its activations are coarser."""
NARROWEST = 9
"""Rows and columns that a matrix has at least, if it is made orthogonal."""
COEFFICIENTS = 3.4445, -4.7750, 2.0315
"""Jordan's: singular values from 0.001 to 1 come near 1, within 0.7 and 1.2, in N_ITERATIONS."""
N_ITERATIONS = 5


class Muon:
    """Muon for the matrices of a network, Adam for the rest of it."""

    def __init__(self, parameters: Iterable[Tensor]) -> None:
        """`parameters` are matrices [n_in, n_out] and vectors, whose `grad` is read."""
        every = list(parameters)
        matrices = [p for p in every if p.ndim == 2 and min(p.shape) >= NARROWEST]
        shapes = dict.fromkeys(p.shape for p in matrices)
        self._groups = [[p for p in matrices if p.shape == shape] for shape in shapes]
        self._momenta = [torch.zeros(len(group), *group[0].shape) for group in self._groups]
        of_groups = {id(p) for p in matrices}
        self._adam = Adam(p for p in every if id(p) not in of_groups)

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move everything along the gradients, and drop them."""
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
    """[n, n_rows, n_columns]: about U V^T of the singular value decomposition U S V^T of each of `matrices`;
    0 stays 0.

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
