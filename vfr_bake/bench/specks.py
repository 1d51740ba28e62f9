"""Specks: single pixels that stand out in one picture where another picture of the same view is calm."""

from __future__ import annotations

import numpy as np

from player.errors import ShapeError

THRESHOLD = 0.1
"""Least difference of a speck from the pixels around it, in one of three channels of 0 to 1."""
CALM = 0.5
"""Largest difference of the other picture there, as a share of the threshold."""


def speck_mask(picture: np.ndarray, reference: np.ndarray, threshold: float = THRESHOLD) -> np.ndarray:
    """Return the specks, [h, w] bool: pixels that differ from the median of the 3 x 3 pixels around them,
    themselves included, by more than `threshold` in a channel in which `reference` differs from its own
    median by at most CALM times `threshold`.

    A detail that is one pixel wide in both pictures, such as a wire or a highlight, does not count. Neither
    does an edge, which the median follows. At the border the nearest pixels are repeated.

    Args:
        picture: [h, w, 3] float, 0..1.
        reference: [h, w, 3] float, 0..1: the model's picture, or the photograph.
        threshold: 0..1.

    Raises ShapeError: the pictures have different sizes.

    >>> calm = np.full((5, 5, 3), 0.2)
    >>> speckled = calm.copy()
    >>> speckled[1, 3] = 0.9
    >>> np.argwhere(speck_mask(speckled, calm)).tolist(), speck_mask(speckled, speckled).any()
    ([[1, 3]], np.False_)
    """
    if picture.shape != reference.shape or picture.ndim != 3:
        raise ShapeError(f"specks: expected two pictures [h, w, 3], got {picture.shape} {reference.shape}")
    stands_out = _from_around(picture) > threshold
    calm = _from_around(reference) <= CALM * threshold
    return np.asarray((stands_out & calm).any(axis=-1))


def _from_around(picture: np.ndarray) -> np.ndarray:
    """Return how far each pixel is from the median of the nine around it, [h, w, 3]."""
    height, width = picture.shape[:2]
    padded = np.pad(picture, ((1, 1), (1, 1), (0, 0)), mode="edge")
    nine = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    return np.abs(picture - np.median(nine, axis=0))
