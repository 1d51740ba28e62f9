"""The pilot network (section 3.3 of the paper): colour of a single sample, for the first steps only.

Compositing features of a fog gives a large head nothing to learn from; standard volume rendering with a
network of two layers of 64 finds the coarse geometry first. It is discarded afterwards.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

from vfr_bake.config import FieldConfig
from vfr_bake.field.initialisation import initialise
from vfr_bake.field.spherical_harmonics import SphericalHarmonics


class Pilot(nn.Module):
    """Colour of every sample of a batch of rays."""

    def __init__(self, config: FieldConfig, width: int = 64) -> None:
        super().__init__()
        self.harmonics = SphericalHarmonics(config.sh_degree)
        self.layers = nn.ModuleList(
            [nn.Linear(config.n_channels + config.sh_degree**2, width), nn.Linear(width, width)]
        )
        self.out = nn.Linear(width, 3)
        initialise(self.layers)

    def forward(self, features: Tensor, dirs: Tensor) -> Tensor:
        """Colours [n_samples, 3] of `features` [n_samples, n_channels] seen along unit `dirs` [n_samples,
        3]."""
        h = torch.cat([features, self.harmonics(dirs)], dim=-1)
        for layer in self.layers:
            h = gelu(layer(h))
        return torch.sigmoid(self.out(h))
