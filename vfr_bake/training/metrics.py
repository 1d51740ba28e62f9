"""Picture quality against photographs; one implementation for training, baking and playing."""

from __future__ import annotations

import numpy as np


def to_8_bit(rgb: np.ndarray) -> np.ndarray:
    """Values in [0, 1] as uint8, rounded to nearest.

    >>> to_8_bit(np.array([0.0, 0.5, 1.0, 7.0])).tolist()
    [0, 128, 255, 255]
    """
    return np.floor(np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of two pictures with values in [0, 1]; infinite for equal ones.

    >>> round(psnr(np.zeros((2, 2, 3)), np.full((2, 2, 3), 0.1)), 3)
    20.0
    """
    error = float(np.mean((np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2))
    return float("inf") if error == 0 else -10.0 * float(np.log10(error))


def over_background(rgba: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Straight-alpha uint8 pictures [..., 4] over a background [3] in [0, 1]: float32 [..., 3] in [0, 1]."""
    values = rgba.astype(np.float32) / 255
    alpha = values[..., 3:]
    return values[..., :3] * alpha + (1 - alpha) * background.astype(np.float32)
