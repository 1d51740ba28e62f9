"""Colours: conversion from sRGB to linear light, and colours that are known for some points only.

The curve is that of IEC 61966-2-1, whose two pieces meet at 0.04045. Pictures, PLY and
OBJ hold sRGB; glTF vertex colours (COLOR_0) and EXR hold linear light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class KnownColours(NamedTuple):
    """Colours of n points, some of which may have none."""

    rgb: np.ndarray
    """[n, 3] float32 or float64 sRGB, 0..1."""
    known: np.ndarray
    """[n] bool, true where the point has a colour."""


def linear_from_srgb(srgb: ArrayLike) -> np.ndarray:
    """Convert sRGB values in [0, 1] to linear light in [0, 1]; any shape, computed in float64.

    >>> linear_from_srgb([0.0, 128 / 255, 1.0]).round(4).tolist()
    [0.0, 0.2159, 1.0]
    """
    value = np.asarray(srgb, np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0) + 0.055) / 1.055) ** 2.4)
