"""The head: one evaluation per pixel turns the composited feature and the view direction into a colour.

Section 3.4 of the paper: a spatial MLP predicts a bottleneck vector and one feature vector f_lm per
spherical-harmonics basis function; e_lm = f_lm Y_lm(d) (equation 4); the directional MLP maps (bottleneck,
e) to the colour. GELU throughout; two spatial and four directional layers, all of one width, and the output
layer.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

from vfr_bake.config import FieldConfig
from vfr_bake.field.initialisation import initialise
from vfr_bake.field.spherical_harmonics import SphericalHarmonics


class Head(nn.Module):
    """rgb = head(sum w_i F_i, d).

    >>> head = Head(FieldConfig(n_levels=2, head_width=8))
    >>> head(torch.zeros(3, 4), torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)).shape
    torch.Size([3, 3])
    """

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        width = config.head_width
        self.width = width
        self.n_sh_features = config.n_sh_features
        self.harmonics = SphericalHarmonics(config.sh_degree)
        n_sh = config.sh_degree**2 * config.n_sh_features
        # The second spatial layer is linear: it emits the bottleneck and the f_lm side by side.
        self.spatial = nn.ModuleList([nn.Linear(config.n_channels, width), nn.Linear(width, width + n_sh)])
        self.directional = nn.ModuleList(
            [nn.Linear(width + n_sh, width)] + [nn.Linear(width, width) for _ in range(3)]
        )
        self.out = nn.Linear(width, 3)
        initialise([*self.spatial, *self.directional])

    def forward(self, features: Tensor, dirs: Tensor) -> Tensor:
        """Colours [n, 3] in [0, 1], sRGB, from `features` [n, n_channels] and unit `dirs` [n, 3]."""
        h = self.spatial[1](gelu(self.spatial[0](features)))
        bottleneck, f = h[:, : self.width], h[:, self.width :]
        basis = self.harmonics(dirs).repeat_interleave(self.n_sh_features, dim=-1)
        h = torch.cat([bottleneck, f * basis], dim=-1)
        for layer in self.directional:
            h = gelu(layer(h))
        return torch.sigmoid(self.out(h))

    def first_weights(self) -> np.ndarray:
        """[width, n_channels] of the first layer, which is linear in the composited feature."""
        return self.spatial[0].weight.detach().numpy()  # type: ignore[operator]
