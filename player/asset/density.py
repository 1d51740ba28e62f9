"""Encode densities in eight bits and decode them; shared by the bake and the player.

Letters: sigma is the volume density in 1/model unit; a code is the integer 0..255 that an asset stores. The
logarithm of sigma is linear in the code, `log sigma = lo + (hi - lo) * code / 255` with `(lo, hi) =
density_range`. It is the CODE that is interpolated between vertices: the density is stored before its
activation.
"""

from __future__ import annotations

import numpy as np


def decode_density(codes: np.ndarray, density_range: tuple[float, float]) -> np.ndarray:
    """Decode codes, interpolated or not, to densities; float32 throughout.

    Args:
        codes: [...] codes, 0..255, any real dtype.
        density_range: log sigma at code 0 and at code 255.

    Returns:
        sigmas: [...] float32, 1/model unit, > 0.

    >>> decode_density(np.array([0, 255]), (0.0, 2.0)).round(3).tolist()
    [1.0, 7.388999938964844]
    """
    low, slope = decode_constants(density_range)
    return np.exp(low + slope * np.asarray(codes, np.float32))


def decode_constants(density_range: tuple[float, float]) -> tuple[np.float32, np.float32]:
    """Return float32 `low` and `slope` with `sigma = exp(low + slope * code)`; every decoder uses these two.

    >>> low, slope = decode_constants((-1.0, 254.0))
    >>> float(low), float(slope)
    (-1.0, 1.0)
    """
    low, high = density_range
    return np.float32(low), np.float32((high - low) / 255)


def encode_density(log_sigmas: np.ndarray, density_range: tuple[float, float]) -> np.ndarray:
    """Encode logarithms of densities as the nearest codes. Values outside the range are clipped; -inf (no
    density) becomes code 0.

    Args:
        log_sigmas: [...] natural logarithm of the density in 1/model unit; no NaN.
        density_range: log sigma at code 0 and at code 255.

    Returns:
        codes: [...] uint8.

    >>> encode_density(np.array([-np.inf, 0.0, 1.0, 9.0]), (0.0, 2.0)).tolist()
    [0, 0, 128, 255]
    """
    low, high = density_range
    codes = (np.asarray(log_sigmas, np.float64) - low) * (255 / (high - low))
    return np.floor(np.clip(codes, 0, 255) + 0.5).astype(np.uint8)
