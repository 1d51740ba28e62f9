"""A Volume Feature Rendering field: hash grid, density network and head."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from vfr_bake.config import FieldConfig
from vfr_bake.field.hash_grid import HashGrid
from vfr_bake.field.networks import LARGEST_LOGIT, Head, make_density
from vfr_bake.kernels import march as kernels


class VfrField(nn.Module):
    """The trained thing. Positions are in the model frame, whose scene box is [-1, 1]^3."""

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        self.config = config
        self.grid = HashGrid(config)
        self.density = make_density(config)
        self.head = Head(config)

    def kernel_arguments(self) -> tuple[tuple, tuple]:
        """(grid, network) as the march kernels take them."""
        return self.grid.kernel_arguments(), self.density.arrays()

    @torch.no_grad()
    def log_densities(self, points: np.ndarray) -> np.ndarray:
        """Pre-activation densities [n] at `points` [n, 3] of the unit cube (model coordinates x as (x + 1) /
        2)."""
        out = np.empty(len(points), points.dtype)
        kernels.density_logits(points, *self.kernel_arguments(), out)
        return np.minimum(out, LARGEST_LOGIT)

    def lookup(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(features [n, n_channels], densities [n]) at `points` [n, 3] of the unit cube, on any device."""
        features = self.grid(points)
        return features, self.density(features)

    def copied_to_cpu(self) -> VfrField:
        """This field, or a copy if it is elsewhere."""
        if self.grid.table.device.type == "cpu":
            return self
        copy = VfrField(self.config)
        copy.load_state_dict(self.state_dict())
        return copy

    @torch.no_grad()
    def features(self, points: np.ndarray) -> np.ndarray:
        """Features [n, n_channels] at `points` [n, 3] of the unit cube."""
        return self.grid(torch.from_numpy(points)).numpy()

    def network_parameters(self) -> list[Tensor]:
        return [*self.density.parameters(), *self.head.parameters()]
