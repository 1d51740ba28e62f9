"""The head's weights as the exported graph takes them, with everything linear folded together."""

from __future__ import annotations

import numpy as np
import torch

from exporters.head.onnx_head import HeadWeights, Layer
from vfr_bake.field.head import Head


def fold_head(head: Head, first_layer: np.ndarray) -> HeadWeights:
    """The head with `first_layer` [width, n_stored] in place of its first weights.

    The bottleneck is a linear map followed by the linear part of the first directional layer; their product
    is one map, which saves a sixth of the head's multiplications and changes nothing but rounding.
    """

    def layer(linear: torch.nn.Linear) -> tuple[np.ndarray, np.ndarray]:
        return linear.weight.detach().double().numpy().T, linear.bias.detach().double().numpy()

    width = head.width
    spatial, spatial_bias = layer(head.spatial[1])  # type: ignore[arg-type]
    first, first_bias = layer(head.directional[0])  # type: ignore[arg-type]
    from_bottleneck, from_sh = first[:width], first[width:]
    to_sh = spatial[:, width:], spatial_bias[width:]
    if head.plain_sh:  # one feature per basis function, which is always 1
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
    """A head of `like`'s form with random weights, which has everything to learn.

    It is `width` wide, has `n_layers` directional layers after the first and `n_bands` bands of spherical
    harmonics; `code_scale` [n_channels] is the size of the features that it will be given, in codes.
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
    )
