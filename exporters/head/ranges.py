"""Ranges of the head's hidden activations, for multiplying in 8 bits.

Letters as in `player.head.graph`: h is the output of the spatial MLP, e the encoded features, z_i the output
of directional layer i. h and z_i come out of an activation function: GELU is never below -0.17, hard swish
never below -0.375.
"""

from __future__ import annotations

import numpy as np

from exporters.head.onnx_head import HeadWeights, Range
from exporters.head.spherical_harmonics import sh_monomials

COVERED = 99.99
"""Percentile at the upper end of a range; the lower end is at 100 minus this. The rare values outside are
clipped, so that the others keep a finer quantization step."""


def activation_ranges(weights: HeadWeights, features: np.ndarray, dirs: np.ndarray) -> tuple[Range, ...]:
    """Return the ranges of h, of e, and of each z_i that another directional layer takes in.

    Args:
        weights: the head.
        features: [n, n_channels] composited features like those that will be played, n at least 1.
        dirs: [n, 3] their unit view directions.
    """
    activated = _gelu if weights.activation == "gelu" else _hard_swish
    h = features.astype(np.float64)
    for weight, bias in weights.spatial:
        h = activated(h @ weight + bias)
    encoded = (h @ weights.to_sh[0] + weights.to_sh[1]) * _basis(weights, dirs)
    d_bottleneck, d_sh, bias = weights.directional_first
    z = activated(h @ d_bottleneck + encoded @ d_sh + bias)
    ranges = [_range(h), _range(encoded)]
    for weight, bias in weights.directional:
        ranges.append(_range(z))
        z = activated(z @ weight + bias)
    return tuple(ranges)


def _basis(weights: HeadWeights, dirs: np.ndarray) -> np.ndarray:
    exponents, coefficients = sh_monomials(weights.sh_degree)
    monomials = np.prod(dirs[:, None, :].astype(np.float64) ** exponents, axis=-1)
    return np.repeat(monomials @ coefficients, weights.n_sh_features, axis=1)


def _range(values: np.ndarray) -> Range:
    low, high = np.percentile(values, [100 - COVERED, COVERED])
    return min(float(low), 0.0), max(float(high), 0.0)


def _gelu(x: np.ndarray) -> np.ndarray:
    """Return the tanh form of GELU, within 5e-4 of the exact one: near enough for a range, and numpy alone
    can compute it."""
    return 0.5 * x * (1 + np.tanh(0.7978845608 * (x + 0.044715 * x**3)))


def _hard_swish(x: np.ndarray) -> np.ndarray:
    return x * np.clip(x / 6 + 0.5, 0.0, 1.0)
