"""A Volume Feature Rendering field: hash grid, density network and head."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from vfr_bake.config import FieldConfig
from vfr_bake.field.hash_grid import HashGrid
from vfr_bake.field.networks import DensityNetwork, HeadNetwork
from vfr_bake.kernels.density import LARGEST_LOGIT, FieldArrays, density_logits


class VfrField(nn.Module):
    """The trained field. Positions are in the model frame, whose scene box is [-1, 1]^3."""

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        self.config = config
        self.grid = HashGrid(config)
        self.density = DensityNetwork(config.n_channels, config.density_width)
        self.head = HeadNetwork(config)

    def arrays(self) -> FieldArrays:
        """Return grid and density network as the kernels take them, for a field on a CPU."""
        return FieldArrays(*self.grid.layout.grid(self.grid.table), *self.density.arrays())

    @torch.no_grad()
    def log_densities(self, points: np.ndarray) -> np.ndarray:
        """Return the pre-activation densities [n] at `points` [n, 3] of the unit cube, where the model
        coordinate x is at (x + 1) / 2."""
        out = np.empty(len(points), points.dtype)
        density_logits(points, self.arrays(), out)
        return np.minimum(out, LARGEST_LOGIT)

    def lookup(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return (features [n, n_channels], densities [n]) at `points` [n, 3] of the
        unit cube, on any device."""
        features = self.grid(points)
        return features, self.density(features)

    def copied_to_cpu(self) -> VfrField:
        """Return this field if it is on a CPU, else a copy there."""
        if self.grid.table.device.type == "cpu":
            return self
        copy = VfrField(self.config)
        copy.load_state_dict(self.state_dict())
        return copy

    @torch.no_grad()
    def features(self, points: np.ndarray) -> np.ndarray:
        """Return the features [n, n_channels] at `points` [n, 3] of the unit cube."""
        return self.grid(torch.from_numpy(points)).numpy()

    def network_parameters(self) -> list[Tensor]:
        return [*self.density.parameters(), *self.head.parameters()]
