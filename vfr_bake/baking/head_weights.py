"""The head's weights as the exported graph takes them, with everything linear folded together."""

from __future__ import annotations

import numpy as np
import torch

from exporters.onnx_head import HeadWeights
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
