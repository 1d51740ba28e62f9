"""Predict the values of a level of a pyramid from the next coarser one, and add the steps that the level
stores: compiled where numba is installed, otherwise in numpy. Both give the same integers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.asset.bricks import BRICK, stored_bits
from player.asset.prediction.compiled import add_to_prediction
from player.compiling import available

_AT_ONCE = 256
"""Bricks whose values are predicted at a time in numpy, so that temporaries take only some megabytes."""


class Places(NamedTuple):
    """Places of the coarser level's vertices around the bricks of a level."""

    bricks: np.ndarray
    """[n_bricks, 4] int32: for each brick, the index of the coarser brick around it in `rows`, and where in
    that one it begins along each axis, 0 or 4."""
    rows: np.ndarray
    """[n_coarse_bricks * 729] int32: the rows of the coarser level's vertices, brick by brick with an apron
    (9 x 9 x 9 each); -1 where there is no vertex."""


def values_from(
    masks: np.ndarray,
    border: np.ndarray,
    places: Places,
    coarse: np.ndarray,
    symbols: np.ndarray,
    step: int,
    limits: tuple[int, int],
    dtype: type[np.generic],
) -> np.ndarray:
    """Return the values [n, n_channels] of a level: clip(predicted + step * symbol), and on the border the
    prediction alone.

    Args:
        masks: [n_bricks, 8] uint64, which vertices exist.
        border: [n_bricks, 8] uint64, which of these have no symbol.
        places: the places of the coarser level's vertices around the bricks.
        coarse: [n_coarse, n_channels] the coarser level's values.
        symbols: [n_stored, n_channels] int16; [0, n_channels] if all are 0.
        step: the quantization step.
        limits: the lowest and the highest value.
        dtype: dtype of the values.
    """
    n = int(np.bitwise_count(masks).sum(dtype=np.int64))
    out = np.empty((n, coarse.shape[1]), dtype)
    if available():
        sums = np.empty(coarse.shape[1], np.int32)
        # arrays of one dtype and layout: numba compiles once for each kind of arrays
        add_to_prediction(
            masks, border, places.bricks, places.rows, np.ascontiguousarray(coarse, dtype),
            np.ascontiguousarray(symbols.T, np.int16), (step, *limits), sums, out,
        )  # fmt: skip
        return out
    row = first_symbol = 0
    for first in range(0, len(masks), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        stored = stored_bits(masks[some])
        values = _predicted(places.bricks[some], places.rows, coarse, stored)
        if len(symbols):
            moved = ~stored_bits(border[some])[stored]
            n_moved = int(np.count_nonzero(moved))
            change = step * symbols[first_symbol : first_symbol + n_moved].astype(np.int32)
            values[moved] = np.clip(values[moved] + change, *limits)
            first_symbol += n_moved
        out[row : row + len(values)] = values
        row += len(values)
    return out


def _predicted(bricks: np.ndarray, rows: np.ndarray, coarse: np.ndarray, stored: np.ndarray) -> np.ndarray:
    """Return the predictions [n, n_channels] int16 at the vertices that `stored` selects: (sum over the 8
    coarser vertices at floor and ceil of half the position + 4) >> 3."""
    n_channels = coarse.shape[1]
    x, y, z = (bricks[:, 1:, None] + np.arange(BRICK // 2 + 1, dtype=np.int32)).transpose(1, 0, 2)
    index = bricks[:, 0, None, None, None].astype(np.int64) * 729 + (
        x[:, :, None, None] * 81 + y[:, None, :, None] * 9 + z[:, None, None, :]
    )
    total = coarse[rows[index]].astype(np.int16)
    for axis in (1, 2, 3):
        total = _doubled(total, axis)
    whole = total.reshape(-1, n_channels)[stored.reshape(-1)]
    whole += 4
    whole >>= 3
    return whole


def _doubled(values: np.ndarray, axis: int) -> np.ndarray:
    """Return twice the values, interpolated along an axis at 8 places from 5 that are twice as far apart."""
    shape = list(values.shape)
    shape[axis] = BRICK
    out = np.empty(shape, values.dtype)
    into, taken = np.moveaxis(out, axis, 0), np.moveaxis(values, axis, 0)
    np.multiply(taken[:-1], 2, out=into[0::2])
    np.add(taken[:-1], taken[1:], out=into[1::2])
    return out
