"""Real spherical harmonics of a direction, from the table that the exported head uses too."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from exporters.head.spherical_harmonics import sh_monomials


class SphericalHarmonics(nn.Module):
    """Y_lm(d) for the bands l < degree, index l * l + l + m.

    >>> SphericalHarmonics(4)(torch.tensor([[0.0, 0.0, 1.0]])).shape
    torch.Size([1, 16])
    """

    exponents: Tensor
    coefficients: Tensor

    def __init__(self, degree: int) -> None:
        super().__init__()
        exponents, coefficients = sh_monomials(degree)
        self._highest = int(exponents.max())  # of the array: a GPU's tensor would have to be waited for
        self.register_buffer("exponents", torch.as_tensor(exponents), persistent=False)
        self.register_buffer(
            "coefficients", torch.as_tensor(coefficients, dtype=torch.float32), persistent=False
        )

    def forward(self, dirs: Tensor) -> Tensor:
        """Basis values [n, degree^2] at unit `dirs` [n, 3]."""
        powers = [torch.ones_like(dirs)]
        for _ in range(self._highest):
            powers.append(powers[-1] * dirs)
        table = torch.stack(powers)  # [degree, n, 3]
        x, y, z = self.exponents.unbind(-1)
        monomials = (table[x, :, 0] * table[y, :, 1] * table[z, :, 2]).T  # [n, n_monomials]
        return monomials @ self.coefficients.to(dirs.dtype)
