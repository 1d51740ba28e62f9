"""The networks of a field: density, head and pilot, and the basis of directions that head and pilot share.

The density of a sample from its feature (section 4 of the paper) is sigma = exp(w2 . relu(w1 F + b1) + b2).

The head turns the composited feature and the view direction into a colour, with one evaluation per
pixel. Section 3.4 of the paper: a spatial MLP predicts a bottleneck vector and one feature vector f_lm
per spherical-harmonics basis function; e_lm = f_lm Y_lm(d) (equation 4); the directional MLP maps
(bottleneck, e) to the colour. It has GELU throughout, two spatial and four directional layers, all of
one width, and the output layer. With plain encoding, the baseline of the paper's ablation, e_lm =
Y_lm(d) and no f_lm is predicted.

The pilot (section 3.3 of the paper) gives the colour of a single sample, for the first steps only. A large
head cannot learn from the composited features of a fog. Standard volume rendering with a network of two
layers of 64 first finds the coarse geometry; this network is then discarded.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, relu

from exporters.head.spherical_harmonics import sh_monomials
from vfr_bake.config import FieldConfig
from vfr_bake.field.fused_head import fused_head
from vfr_bake.kernels.density import LARGEST_LOGIT, DensityArrays


class TruncatedExp(torch.autograd.Function):
    """exp(x) with x clamped to [-15, 15]. Its gradient is that of exp at the clamped value everywhere, so
    that a saturated density can come down and a vanished one can come back."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        y = x.clamp(-LARGEST_LOGIT, LARGEST_LOGIT).exp()
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx, *grads: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return grads[0] * y


class DensityNetwork(nn.Module):
    """Density network with one hidden layer, or a linear map if `width` is 0; float32 always.

    >>> DensityNetwork(8, 16)(torch.zeros(3, 8)).shape
    torch.Size([3])
    """

    def __init__(self, n_channels: int, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(n_channels, width) if width else None
        self.out = nn.Linear(width or n_channels, 1)
        nn.init.zeros_(self.out.bias)
        if self.hidden is not None:
            initialise([self.hidden])

    def logits(self, features: Tensor) -> Tensor:
        """Return the pre-activations [n] of the density at `features` [n, n_channels]."""
        if self.hidden is not None:
            features = torch.relu(self.hidden(features))
        return self.out(features)[:, 0]

    def forward(self, features: Tensor) -> Tensor:
        """Return the densities [n] in 1/model unit."""
        return TruncatedExp.apply(self.logits(features))  # type: ignore[return-value]

    def matrices(self) -> list[Tensor]:
        """Return the weights of the layers, without the biases."""
        return [p for p in self.parameters() if p.ndim == 2]

    def arrays(self) -> DensityArrays:
        """Return the weights as the kernels take them."""
        w2 = self.out.weight.detach().numpy()[0]
        b2 = self.out.bias.detach().numpy()[0]
        if self.hidden is None:
            return DensityArrays(np.zeros((0, 0), w2.dtype), np.zeros(0, w2.dtype), w2, b2)
        w1 = np.ascontiguousarray(self.hidden.weight.detach().numpy().T)
        return DensityArrays(w1, self.hidden.bias.detach().numpy(), w2, b2)


def initialise(layers: Iterable[nn.Module]) -> None:
    """Initialise layers that a GELU or ReLU follows (He et al. 2015): weights of
    variance 2 / n_in, biases of 0.

    torch's own default has a sixth of that variance, so a signal through the head's six layers begins a
    hundred times fainter; on the lego scene it is 0.5 dB behind after 1,200 steps.
    """
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)


class SphericalHarmonics(nn.Module):
    """Spherical-harmonics basis Y_lm(d) for the bands l < degree, at index l * l + l + m.

    >>> SphericalHarmonics(4)(torch.tensor([[0.0, 0.0, 1.0]])).shape
    torch.Size([1, 16])
    """

    exponents: Tensor
    coefficients: Tensor

    def __init__(self, degree: int) -> None:
        super().__init__()
        exponents, coefficients = sh_monomials(degree)
        self._highest = int(exponents.max())  # from the array: reading a tensor would wait for the GPU
        self.register_buffer("exponents", torch.as_tensor(exponents), persistent=False)
        self.register_buffer(
            "coefficients", torch.as_tensor(coefficients, dtype=torch.float32), persistent=False
        )

    def forward(self, dirs: Tensor) -> Tensor:
        """Return the basis values [n, degree^2] at unit `dirs` [n, 3]."""
        powers = [torch.ones_like(dirs)]
        for _ in range(self._highest):
            powers.append(powers[-1] * dirs)
        table = torch.stack(powers)  # [degree, n, 3]
        x, y, z = self.exponents.unbind(-1)
        monomials = (table[x, :, 0] * table[y, :, 1] * table[z, :, 2]).T  # [n, n_monomials]
        return monomials @ self.coefficients.to(dirs.dtype)


class HeadNetwork(nn.Module):
    """The head: rgb = head(sum w_i F_i, d).

    >>> head = HeadNetwork(FieldConfig(n_levels=2, head_width=8))
    >>> head(torch.zeros(3, 4), torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)).shape
    torch.Size([3, 3])
    """

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        width = config.head_width
        self.width = width
        self.activation = {"gelu": gelu, "relu": relu}[config.activation]
        self.plain_sh = config.view_encoding == "sh"
        self._is_fused = self.activation is gelu and not self.plain_sh
        self.products = torch.float32
        """Type of the matrix products on a CPU if a gradient is wanted; weights are float32 always."""
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
        """Return colours [n, 3] in [0, 1], sRGB, from `features` [n, n_channels] and unit `dirs` [n, 3]."""
        fits = features.device.type == "cpu" and features.dtype == torch.float32
        if self._is_fused and fits and not torch.compiler.is_compiling():
            basis = self.harmonics(dirs).repeat_interleave(self.n_sh_features, dim=-1)
            products = self.products if torch.is_grad_enabled() else torch.float32
            return fused_head(features, basis, [*self.spatial, *self.directional, self.out], products)
        h = self.spatial[1](self.activation(self.spatial[0](features)))
        encoded = self.harmonics(dirs)
        if not self.plain_sh:
            encoded = encoded.repeat_interleave(self.n_sh_features, dim=-1) * h[:, self.width :]
        h = torch.cat([h[:, : self.width], encoded], dim=-1)
        for layer in self.directional:
            h = self.activation(layer(h))
        return torch.sigmoid(self.out(h))

    def first_weights(self) -> np.ndarray:
        """Return the weights [width, n_channels] of the first layer, which is linear
        in the composited feature."""
        return self.spatial[0].weight.detach().numpy()  # type: ignore[operator]


class Pilot(nn.Module):
    """The pilot network, which gives a colour to every sample of a batch of rays."""

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        self.harmonics = SphericalHarmonics(config.sh_degree)
        self.layers = nn.ModuleList(
            [nn.Linear(config.n_channels + config.sh_degree**2, 64), nn.Linear(64, 64)]
        )
        self.out = nn.Linear(64, 3)
        initialise(self.layers)

    def forward(self, features: Tensor, dirs: Tensor) -> Tensor:
        """Return the colours [n_samples, 3] of `features` [n_samples, n_channels] seen along
        unit `dirs` [n_samples, 3]."""
        h = torch.cat([features, self.harmonics(dirs)], dim=-1)
        for layer in self.layers:
            h = gelu(layer(h))
        return torch.sigmoid(self.out(h))
