"""Compute the values of a level of a pyramid from those of the next coarser level, vertex by vertex; compiled
code for `player.asset.prediction.prediction`."""

from __future__ import annotations

import numpy as np

from player.compiling import compiled


@compiled
def add_to_prediction(
    masks: np.ndarray,
    border: np.ndarray,
    coarse_bricks: np.ndarray,
    coarse_rows: np.ndarray,
    coarse: np.ndarray,
    symbols: np.ndarray,
    limits: tuple[int, int, int],
    sums: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write the value of every vertex to `out`: the coarser level's prediction, and, off the border, plus the
    step times the symbol, clipped to the limits.

    Args:
        masks: [n_bricks, 8] uint64, which vertices exist.
        border: [n_bricks, 8] uint64, which of these have no symbol.
        coarse_bricks: [n_bricks, 4] int32: for each brick, the index of the coarser brick around it in
            `coarse_rows`, and where in that one it begins along each axis, 0 or 4.
        coarse_rows: [n_coarse_bricks * 729] int32: the rows of the coarser level's vertices.
        coarse: [n_coarse, n_channels] values of the coarser level, in the dtype of `out`.
        symbols: [n_channels, n_stored] int16; [n_channels, 0] if all are 0.
        limits: the step, the lowest and the highest value.
        sums: [n_channels] int32, scratch memory for sums.
        out: [n, n_channels], written here.
    """
    step, low, high = limits
    n_channels = out.shape[1]
    row = stored = 0
    for brick in range(len(masks)):
        first = np.int64(coarse_bricks[brick, 0]) * 729
        x0, y0, z0 = coarse_bricks[brick, 1], coarse_bricks[brick, 2], coarse_bricks[brick, 3]
        for x in range(8):
            word, at_border = masks[brick, x], border[brick, x]
            xa, xb = (x0 + (x >> 1)) * 81, (x0 + ((x + 1) >> 1)) * 81
            for bit in range(64):
                if not (word >> np.uint64(bit)) & np.uint64(1):
                    continue
                y, z = bit >> 3, bit & 7
                ya, yb = (y0 + (y >> 1)) * 9, (y0 + ((y + 1) >> 1)) * 9
                za, zb = z0 + (z >> 1), z0 + ((z + 1) >> 1)
                a, b = coarse_rows[first + xa + ya + za], coarse_rows[first + xa + ya + zb]
                c, d = coarse_rows[first + xa + yb + za], coarse_rows[first + xa + yb + zb]
                e, f = coarse_rows[first + xb + ya + za], coarse_rows[first + xb + ya + zb]
                g, h = coarse_rows[first + xb + yb + za], coarse_rows[first + xb + yb + zb]
                for i in range(n_channels):
                    total = (
                        np.int32(coarse[a, i]) + np.int32(coarse[b, i]) + np.int32(coarse[c, i])
                        + np.int32(coarse[d, i]) + np.int32(coarse[e, i]) + np.int32(coarse[f, i])
                        + np.int32(coarse[g, i]) + np.int32(coarse[h, i])
                    )  # fmt: skip
                    sums[i] = (total + 4) >> 3
                if symbols.shape[1] and not (at_border >> np.uint64(bit)) & np.uint64(1):
                    for i in range(n_channels):
                        sums[i] = min(max(sums[i] + step * np.int32(symbols[i, stored]), low), high)
                    stored += 1
                for i in range(n_channels):
                    out[row, i] = sums[i]
                row += 1
