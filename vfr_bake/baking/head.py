"""The head in the form of the exported graph, with consecutive linear maps folded together, and the same
graph in torch, where it can be trained: in float32, or as it is played in 8 bits.

Letters are as in `player.head.graph`. In 8 bits, activations are rounded to 256 levels of a fixed range, and
weights as described in `exporters.head.onnx_head.weight_scales`. The torch graph rounds both in the same
places as the exported one; gradients pass as if nothing were rounded (straight-through estimator).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, hardswish

from exporters.head.onnx_head import HeadWeights, Layer, Range, head_onnx, levels
from player.head.graph import PAIR_LIMIT
from player.head.head import Head as PlayedHead
from vfr_bake.data.threads import in_threads
from vfr_bake.field.networks import HeadNetwork, SphericalHarmonics
from vfr_bake.rendering.render import HEAD_CHUNK


def fold_head(head: HeadNetwork, first_layer: np.ndarray) -> HeadWeights:
    """Return the folded head, with `first_layer` [width, n_stored] in place of its first weights.

    The bottleneck is a linear map that is followed by the linear part of the first directional layer. Both
    are folded into their product, which saves a sixth of the head's multiplications and changes nothing but
    rounding.
    """

    def layer(linear: torch.nn.Linear) -> tuple[np.ndarray, np.ndarray]:
        return linear.weight.detach().double().numpy().T, linear.bias.detach().double().numpy()

    width = head.width
    spatial, spatial_bias = layer(head.spatial[1])  # type: ignore[arg-type]
    first, first_bias = layer(head.directional[0])  # type: ignore[arg-type]
    from_bottleneck, from_sh = first[:width], first[width:]
    to_sh = spatial[:, width:], spatial_bias[width:]
    if head.plain_sh:  # the features that multiply the basis functions are all 1
        to_sh = np.zeros((width, len(from_sh))), np.ones(len(from_sh))
    return HeadWeights(
        spatial=((first_layer.T, layer(head.spatial[0])[1]),),  # type: ignore[arg-type]
        to_sh=to_sh,
        directional_first=(
            spatial[:, :width] @ from_bottleneck,
            from_sh,
            first_bias + spatial_bias[:width] @ from_bottleneck,
        ),
        directional=tuple(layer(linear) for linear in head.directional[1:]),  # type: ignore[arg-type]
        output=layer(head.out),
        sh_degree=int(np.sqrt(head.harmonics.coefficients.shape[1])),
        n_sh_features=head.n_sh_features,
    )


def small_head(
    like: HeadWeights, width: int, n_layers: int, n_bands: int, code_scale: np.ndarray
) -> HeadWeights:
    """Make a head of `like`'s form with random weights, still to be trained.

    It is `width` wide, and has `n_layers` directional layers after the first and `n_bands` bands of spherical
    harmonics. `code_scale` [n_channels] is the typical size of its input features, in codes.
    """
    random = np.random.default_rng(0)

    def layer(n_in: int, n_out: int, gain: float = np.sqrt(2)) -> Layer:
        return random.normal(0, gain / np.sqrt(n_in), (n_in, n_out)), np.zeros(n_out)

    n_encoded = n_bands**2 * like.n_sh_features
    first, bias = layer(like.n_channels, width)
    return HeadWeights(
        spatial=((first / code_scale[:, None], bias),),
        to_sh=layer(width, n_encoded, 1.0),
        directional_first=(layer(width, width)[0], layer(n_encoded, width, 1.0)[0], np.zeros(width)),
        directional=tuple(layer(width, width) for _ in range(n_layers)),
        output=layer(width, 3, 1.0),
        sh_degree=n_bands,
        n_sh_features=like.n_sh_features,
        activation="hard_swish",
    )


class FoldedHead(nn.Module):
    """The exported graph in torch.

    Args:
        weights: the weights before training.
        units: [n_channels] the input features are divided by these units, so that channels with small codes
            train as fast as those with large ones; None divides by 1.
        ranges: activation ranges from `exporters.head.ranges`, if the wide layers are to be multiplied in 8
            bits; None for float32.
    """

    def __init__(
        self,
        weights: HeadWeights,
        units: np.ndarray | None = None,
        ranges: tuple[Range, ...] | None = None,
    ) -> None:
        super().__init__()
        self._like, self._ranges = weights, ranges
        self._activation = gelu if weights.activation == "gelu" else hardswish
        self._units = np.ones(weights.n_channels) if units is None else units.astype(np.float64)
        self.harmonics = SphericalHarmonics(weights.sh_degree)
        layers = [*weights.spatial, weights.to_sh, *weights.directional, weights.output]
        d_bottleneck, d_sh, bias = weights.directional_first
        arrays = [array for layer in layers for array in layer] + [d_bottleneck, d_sh, bias]
        arrays[0] = arrays[0] * self._units[:, None]
        self.arrays = nn.ParameterList([torch.tensor(a, dtype=torch.float32) for a in arrays])
        self._per_unit = torch.tensor(1 / self._units, dtype=torch.float32)

    def forward(self, codes: Tensor, dirs: Tensor) -> Tensor:
        """Compute colours [n, 3] from composited codes [n, n_stored] and unit directions [n, 3]."""
        layers, (d_bottleneck, d_sh, bias) = self._layers()
        n_spatial = len(self._like.spatial)
        h = codes * self._per_unit
        for weight, b in layers[:n_spatial]:
            h = self._activation(torch.addmm(b, h, weight))
        h = self._rounded(h, 0)
        weight, b = layers[n_spatial]
        basis = self.harmonics(dirs).repeat_interleave(self._like.n_sh_features, dim=-1)
        encoded = self._rounded(torch.addmm(b, h, self._rounded_weight(weight)) * basis, 1)
        first = torch.addmm(bias, h, self._rounded_weight(d_bottleneck))
        h = self._activation(first + encoded @ self._rounded_weight(d_sh))
        for index, (weight, b) in enumerate(layers[n_spatial + 1 : -1], start=2):
            h = self._activation(torch.addmm(b, self._rounded(h, index), self._rounded_weight(weight)))
        weight, b = layers[-1]
        return torch.sigmoid(torch.addmm(b, h, weight))

    def _rounded(self, x: Tensor, index: int) -> Tensor:
        """Round activations `x` to the 256 levels of range number `index`, if the head is in 8 bits."""
        if self._ranges is None:
            return x
        scale, zero = levels(self._ranges[index])
        codes = (x.detach() / scale).round_().add_(zero).clamp_(0, 255)
        return x + ((codes - zero) * scale - x.detach())

    def _rounded_weight(self, weight: Tensor) -> Tensor:
        if self._ranges is None:
            return weight
        w = weight.detach()
        pairs = nn.functional.pad(w.abs(), (0, 0, 0, len(w) % 2)).unflatten(0, (-1, 2)).sum(dim=1)
        scales = pairs.amax(dim=0).clamp_min(1e-12) / (PAIR_LIMIT - 1)
        return weight + ((w / scales).round_() * scales - w)

    def _layers(self) -> tuple[list[tuple[Tensor, Tensor]], tuple[Tensor, Tensor, Tensor]]:
        a = list(self.arrays)
        return list(zip(a[:-3:2], a[1:-3:2], strict=True)), (a[-3], a[-2], a[-1])

    def weights(self) -> HeadWeights:
        """Return the weights as numpy arrays, in the form in which they were given."""
        layers, first = self._layers()

        def plain(tensors: tuple[Tensor, ...]) -> tuple[np.ndarray, ...]:
            return tuple(t.detach().double().numpy() for t in tensors)

        arrays: list[Layer] = [plain(layer) for layer in layers]  # type: ignore[misc]
        arrays[0] = (arrays[0][0] / self._units[:, None], arrays[0][1])
        n_spatial = len(self._like.spatial)
        return HeadWeights(
            spatial=tuple(arrays[:n_spatial]),
            to_sh=arrays[n_spatial],
            directional_first=plain(first),  # type: ignore[arg-type]
            directional=tuple(arrays[n_spatial + 1 : -1]),
            output=arrays[-1],
            sh_degree=self._like.sh_degree,
            n_sh_features=self._like.n_sh_features,
            activation=self._like.activation,
        )


def runner(
    weights: HeadWeights, ranges: tuple[Range, ...] | None = None
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the head, run as the player runs it, as a function from composited features [n, n_channels] and
    unit directions [n, 3], both float32, to colours [n, 3]. With `ranges`, it computes in 8 bits."""
    head = PlayedHead(head_onnx(weights, ranges), weights.n_channels, compiled=True)

    def colours(features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        parts = [slice(first, first + HEAD_CHUNK) for first in range(0, len(features), HEAD_CHUNK)]
        found = in_threads(lambda part: head(features[part], dirs[part]), parts, None)
        return np.concatenate([np.empty((0, 3), np.float32), *found])

    return colours


def between(first: HeadWeights, second: HeadWeights) -> HeadWeights:
    """Return the head halfway between two heads with layers of the same sizes."""

    def mixed(a: Any, b: Any) -> Any:
        if isinstance(a, tuple):
            return tuple(mixed(*two) for two in zip(a, b, strict=True))
        return a + (b - a) / 2 if isinstance(a, np.ndarray) else a

    return HeadWeights(**{name: mixed(value, vars(second)[name]) for name, value in vars(first).items()})
