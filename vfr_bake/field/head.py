"""The head: one evaluation per pixel turns the composited feature and the view direction into a colour.

Section 3.4 of the paper: a spatial MLP predicts a bottleneck vector and one feature vector f_lm per
spherical-harmonics basis function; e_lm = f_lm Y_lm(d) (equation 4); the directional MLP maps (bottleneck,
e) to the colour. GELU throughout; two spatial and four directional layers, all of one width, and the output
layer. With plain encoding, the baseline of the paper's ablation, e_lm = Y_lm(d) and nothing is predicted.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, relu

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
        self.activation = {"gelu": gelu, "relu": relu}[config.activation]
        self.plain_sh = config.view_encoding == "sh"
        self.n_sh_features = 1 if self.plain_sh else config.n_sh_features
        self.harmonics = SphericalHarmonics(config.sh_degree)
        n_sh = config.sh_degree**2 * self.n_sh_features
        # The second spatial layer is linear: it emits the bottleneck and the f_lm side by side.
        n_predicted = width + (0 if self.plain_sh else n_sh)
        self.spatial = nn.ModuleList([nn.Linear(config.n_channels, width), nn.Linear(width, n_predicted)])
        self.directional = nn.ModuleList(
            [nn.Linear(width + n_sh, width)]
            + [nn.Linear(width, width) for _ in range(config.n_directional_layers - 1)]
        )
        self.out = nn.Linear(width, 3)
        initialise([*self.spatial, *self.directional])

    def forward(self, features: Tensor, dirs: Tensor) -> Tensor:
        """Colours [n, 3] in [0, 1], sRGB, from `features` [n, n_channels] and unit `dirs` [n, 3]."""
        h = self.spatial[1](self.activation(self.spatial[0](features)))
        encoded = self.harmonics(dirs)
        if not self.plain_sh:
            encoded = encoded.repeat_interleave(self.n_sh_features, dim=-1) * h[:, self.width :]
        h = torch.cat([h[:, : self.width], encoded], dim=-1)
        for layer in self.directional:
            h = self.activation(layer(h))
        return torch.sigmoid(self.out(h))

    def first_weights(self) -> np.ndarray:
        """[width, n_channels] of the first layer, which is linear in the composited feature."""
        return self.spatial[0].weight.detach().numpy()  # type: ignore[operator]
