"""Arrays that compiled code works in, and a way to see that it keeps to them.

Compiled code does not look where it writes: a size that was computed wrongly overwrites whatever lies behind
an array, and shows much later, elsewhere or never. With `VFR_CANARIES=1` in the environment, as in the tests
and in the fuzzer, every such array has known bytes before and behind it, and whoever has called compiled code
looks whether they are still there.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

CANARIES = os.environ.get("VFR_CANARIES") == "1"
"""Whether arrays have canaries; the environment is read once, when this is imported."""

ROOM = 4096
"""Bytes of a canary, of which there is one before and one behind an array; a multiple of every alignment."""
CANARY = 0xA5
"""What a canary is made of: no number that a march writes by itself."""
NOTHING = 0xFF
"""What an array without a value is made of while there are canaries: NaN, or -1."""


def scratch(shape: int | tuple[int, ...], dtype: DTypeLike, fill: Any = None) -> np.ndarray:
    """An array for compiled code to work in.

    Args:
        shape: as numpy takes it.
        dtype: of the numbers.
        fill: what every number is at first; None leaves them as they come.

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
    """Look whether the canaries of arrays of `scratch` are as they were, if there are any.

    Args:
        arrays: each an array, or a tuple of such.

    Raises:
        AssertionError: compiled code has written beside an array; that is a bug of ours, whatever the asset.
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
