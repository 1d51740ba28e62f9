"""Sampling of an object's pixels by detail: pixels with detail around them teach most, and are drawn more
often.

The gradient of a step is a sum over random pixels of the training pictures. Its variance is least if pixels
are drawn in proportion to the size of their own gradients, and so about to their errors (importance sampling;
Katharopoulos and Fleuret, "Not all samples are created equal", 2018). Errors are large where the pictures
have edges and texture; the plain middle of a surface is learned from a few rays. So the probability q of a
pixel that is not transparent follows the contrast around it, which is known before training begins:

    q ~ MIX + (1 - MIX) g / mean(g),   g = (mean of the squared differences around the pixel) ^ POWER.

A map of the errors themselves, in blocks of 8x8 pixels, is no better, because detail is finer than blocks.
The background is drawn as often as if all pixels were equally likely: its rays cost little, and show which
space is empty.

Importance sampling would also divide each error by its pixel's probability, so that the expected loss stays
the plain mean over all pixels. That is not done here: Adam undoes most of such factors, and the rest is
noise.
"""

from __future__ import annotations

import numpy as np

from vfr_bake.kernels.detail import neighbour_squares, window_powers

MIX = 0.1
"""Share of the draws that is spread evenly over all pixels that are not transparent."""
POWER = 0.3
"""Exponent of the squared contrast: errors grow about as this power of it."""
WINDOW = 3
"""Side of the square of pixels over which contrast is averaged."""
MEAN_LOTS = 24
"""Mean number of lots of a pixel. Lots are whole numbers from 1 to 255, so that they fit into a byte."""


def detail_lots(rgba: np.ndarray) -> np.ndarray:
    """Return the lots [height, width] uint8 of the pixels of `rgba` [height, width, 4] uint8, with straight
    alpha: how often each pixel is drawn, relative to others. Lots are 1 to 255, and on average about
    MEAN_LOTS both for transparent pixels and for the others.

    >>> rgba = np.full((64, 64, 4), 255, np.uint8)
    >>> rgba[:, 16:, :3], rgba[:, 32:, 3] = 90, 0
    >>> detail_lots(rgba)[5, [5, 14, 15, 16, 22, 30, 31, 32, 40]].tolist()
    [2, 105, 128, 128, 2, 108, 132, 24, 24]
    """
    squares, powers = (np.empty(rgba.shape[:2], np.float32) for _ in range(2))
    neighbour_squares(rgba, squares)
    window_powers(squares, WINDOW // 2, np.float32(POWER), powers)
    lots, matter = np.full_like(powers, MEAN_LOTS), rgba[..., 3] > 0
    found = powers[matter]
    if found.any():
        lots[matter] = MEAN_LOTS * (MIX + (1 - MIX) / found.mean() * found)
    return np.clip(np.rint(lots), 1, 255).astype(np.uint8)
