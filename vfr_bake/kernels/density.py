"""Field in the form that kernels take, and its density at a point (section 4 of the paper):

    sigma = exp(w2 . relu(w1 F + b1) + b2),

where the logit, the number before the exponential, is clamped.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from player.march.march import MAX_TAU
from vfr_bake.kernels import njit
from vfr_bake.kernels.hash_grid import FLAGS, encode_point

LARGEST_LOGIT = 15.0
"""Logits are clamped to this: exp(15) = 3e6 per model unit is opaque in one step of any length in use."""


class Limits(NamedTuple):
    """The largest logit, and the optical depth at which rays stop."""

    largest_logit: np.floating
    opaque_depth: np.floating


LIMITS = Limits(np.float32(LARGEST_LOGIT), MAX_TAU)
"""The limits of all kernels, in float32."""


class DensityArrays(NamedTuple):
    """Weights of a density network."""

    w1: np.ndarray
    """[n_channels, width]; empty for a linear map."""
    b1: np.ndarray
    """[width]."""
    w2: np.ndarray
    """[width], or [n_channels] for a linear map."""
    b2: np.floating


class FieldArrays(NamedTuple):
    """Field in the form that kernels take: the members of its `HashGridArrays` and of its `DensityArrays`."""

    table: np.ndarray
    scales: np.ndarray
    offsets: np.ndarray
    hashed: np.ndarray
    mask: int
    w1: np.ndarray
    b1: np.ndarray
    w2: np.ndarray
    b2: np.floating


@njit(fastmath=FLAGS, error_model="numpy")
def density_logit(feature, field, hidden):
    """Return the logit at a point with the `feature` [n_channels]; `hidden` [width] is scratch."""
    w1, b1, w2, b2 = field.w1, field.b1, field.w2, field.b2
    kind = feature.dtype.type
    total = b2
    if w1.shape[0] == 0:
        for c in range(feature.shape[0]):
            total += w2[c] * feature[c]
        return total
    for j in range(b1.shape[0]):
        hidden[j] = b1[j]
    # Four channels at a time, because reading and writing each sum takes longer than four products.
    whole = feature.shape[0] // 4 * 4
    for c in range(0, whole, 4):
        f, g, h, k = feature[c], feature[c + 1], feature[c + 2], feature[c + 3]
        for j in range(b1.shape[0]):
            hidden[j] += (f * w1[c, j] + g * w1[c + 1, j]) + (h * w1[c + 2, j] + k * w1[c + 3, j])
    for c in range(whole, feature.shape[0]):
        for j in range(b1.shape[0]):
            hidden[j] += feature[c] * w1[c, j]
    for j in range(b1.shape[0]):
        total += w2[j] * max(hidden[j], kind(0))
    return total


@njit(inline="always")
def look_up(x, y, z, field, limits, feature, hidden):
    """Return the density at a point of the unit cube, and write its feature to `feature` [n_channels]."""
    encode_point(x, y, z, field, feature)
    return np.exp(min(density_logit(feature, field, hidden), limits.largest_logit))


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def density_logits(points, field, out):
    """Write the logits [n_points] at `points` [n_points, 3] of the unit cube to `out`."""
    block = 1024
    for start in prange((points.shape[0] + block - 1) // block):
        feature = np.zeros(2 * field.scales.shape[0], out.dtype)
        hidden = np.zeros(field.b1.shape[0], out.dtype)
        for i in range(start * block, min((start + 1) * block, points.shape[0])):
            encode_point(points[i, 0], points[i, 1], points[i, 2], field, feature)
            out[i] = density_logit(feature, field, hidden)
