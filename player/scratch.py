"""Work arrays for compiled code, and a check that it does not write outside of them.

Compiled code does not check where it writes: with a wrongly computed size, it overwrites whatever lies behind
an array, which shows much later, elsewhere or never. With `VFR_CANARIES=1` in the environment, as in the
tests and in the fuzzer, every such array has known bytes before and behind it. Callers of compiled code then
check that these bytes are unchanged.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

CANARIES = os.environ.get("VFR_CANARIES") == "1"
"""Whether arrays have canaries; the environment is read once, when this is imported."""

ROOM = 4096
"""Bytes of a canary. There is one before and one behind each array; the size is a multiple of every
alignment."""
CANARY = 0xA5
"""The byte that canaries consist of, which a march does not write by itself."""
NOTHING = 0xFF
"""The byte that fills arrays without a value while there are canaries: it gives NaN, or -1."""


def scratch(shape: int | tuple[int, ...], dtype: DTypeLike, fill: Any = None) -> np.ndarray:
    """Make an array for compiled code to work in.

    Args:
        shape: the shape, as for numpy.
        dtype: the type of the numbers.
        fill: the initial value of every number; None leaves them uninitialised.

    >>> scratch((2, 3), np.float32, 0).tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    if not CANARIES:
        if fill is None:
            return np.empty(shape, dtype)
        return np.zeros(shape, dtype) if fill == 0 else np.full(shape, fill, dtype)
    n_bytes = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
    guarded = np.full(n_bytes + 2 * ROOM, CANARY, np.uint8)
    inside = guarded[ROOM : ROOM + n_bytes]
    inside[:] = NOTHING
    array = inside.view(dtype).reshape(shape)
    if fill is not None:
        array[...] = fill
    return array


def check_scratch(*arrays: Any) -> None:
    """Check that the canaries of arrays of `scratch` are unchanged, if there are any.

    Args:
        arrays: arrays, or tuples of arrays.

    Raises:
        AssertionError: compiled code has written beside an array. That is a bug of this project, whatever the
            asset.
    """
    if not CANARIES:
        return
    for array in arrays:
        if isinstance(array, tuple):
            check_scratch(*array)
            continue
        guarded = array.base
        before, behind = guarded[:ROOM] != CANARY, guarded[-ROOM:] != CANARY
        if before.any() or behind.any():
            side, at = ("before", ROOM - before.argmax()) if before.any() else ("behind", behind.argmax() + 1)
            raise AssertionError(
                f"compiled code: a scratch array {array.shape} {array.dtype}: "
                f"expected nothing to be written beside it, got another byte {at} bytes {side} it"
            )
