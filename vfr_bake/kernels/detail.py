"""Contrast around the pixels of a picture."""

from __future__ import annotations

import numpy as np
from numba import prange

from vfr_bake.kernels import njit


@njit(cache=True)
def _squares_to(a, b):
    """Return the squared difference of two pixels [4] uint8, summed over premultiplied colours and alpha, in
    levels of 0 to 255."""
    alpha_a, alpha_b = np.float32(a[3]), np.float32(b[3])
    scale = np.float32(1 / 255)
    total = (alpha_a - alpha_b) ** 2
    for c in range(3):
        total += ((np.float32(a[c]) * alpha_a - np.float32(b[c]) * alpha_b) * scale) ** 2
    return total


@njit(parallel=True, cache=True)
def neighbour_squares(rgba, out):
    """Write to `out` [height, width] float32 the squared differences between each pixel of `rgba`
    [height, width, 4] uint8 and its four neighbours, summed over the neighbours and the channels."""
    height, width = out.shape
    for y in prange(height):
        for x in range(width):
            total = np.float32(0)
            if y > 0:
                total += _squares_to(rgba[y, x], rgba[y - 1, x])
            if y + 1 < height:
                total += _squares_to(rgba[y, x], rgba[y + 1, x])
            if x > 0:
                total += _squares_to(rgba[y, x], rgba[y, x - 1])
            if x + 1 < width:
                total += _squares_to(rgba[y, x], rgba[y, x + 1])
            out[y, x] = total


@njit(parallel=True, cache=True)
def window_powers(values, reach, power, out):
    """Write to `out` [height, width] float32 the mean of `values` [height, width] over a square window around
    each pixel, 2 reach + 1 pixels wide, raised to `power`. Outside the picture, the pixels of its edge are
    repeated."""
    height, width = out.shape
    for y in prange(height):
        for x in range(width):
            total = np.float32(0)
            for i in range(y - reach, y + reach + 1):
                row = min(max(i, 0), height - 1)
                for j in range(x - reach, x + reach + 1):
                    total += values[row, min(max(j, 0), width - 1)]
            out[y, x] = (total / np.float32((2 * reach + 1) ** 2)) ** power
