"""Pictures for people: photograph, rendered picture and where the two differ, side by side."""

from __future__ import annotations

import numpy as np

from player.errors import ShapeError
from vfr_bake.training.metrics import to_8_bit

BRIGHTEST_ERROR = 0.25
"""White in the error map is a difference of this or more, in [0, 1]; fixed, so that views can be compared."""


def comparison(photograph: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Photograph | rendered | error map, [height, 3 width, 3] uint8.

    `photograph`, `rgb`: [height, width, 3] in [0, 1].

    Raises ShapeError: the pictures are not [height, width, 3] of one size.

    >>> comparison(np.zeros((4, 5, 3)), np.ones((4, 5, 3))).shape
    (4, 15, 3)
    """
    if photograph.shape != rgb.shape or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ShapeError(
            f"pictures: expected [height, width, 3] twice, got {list(photograph.shape)} and {list(rgb.shape)}"
        )
    return np.concatenate([to_8_bit(photograph), to_8_bit(rgb), error_map(photograph, rgb)], axis=1)


def error_map(photograph: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """The largest difference of the three channels as a colour [height, width, 3] uint8.

    Black for none, then red, yellow, and white from `BRIGHTEST_ERROR` on.

    >>> error_map(np.zeros((1, 3, 3)), np.array([[[0, 0, 0], [0, 0.25 / 3, 0], [1, 1, 1]]])).tolist()
    [[[0, 0, 0], [255, 0, 0], [255, 255, 255]]]
    """
    error = np.abs(photograph.astype(np.float64) - rgb).max(axis=2, keepdims=True) / BRIGHTEST_ERROR
    return to_8_bit(3 * error - np.arange(3))
