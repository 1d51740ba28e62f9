"""Arrays that hold float32 or bfloat16, for kernels that take either.

A bfloat16 is the upper half of a float32. NumPy has no such type, so these arrays are int16 with the same
bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic, overload
from torch import Tensor

HALF_UNIT, NAN = np.int32(0x7FFF), np.int32(0x7FC0)
"""Half of the lowest bit of a bfloat16, in bits of a float32, minus one; and the bits of a bfloat16 NaN."""


def fast_products() -> torch.dtype:
    """Return bfloat16 if the processor multiplies such matrices in half of the time, float32 otherwise.

    AMD's processors do from Zen 4 on. Intel's before AMX gain nothing. A virtual machine may claim to have
    AMX without having it, and torch's products then end the process.
    """
    has_them = bool(binding.get_host_cpu_features().get("avx512bf16"))
    return torch.bfloat16 if has_them and binding.get_host_cpu_name().startswith("znver") else torch.float32


def as_array(tensor: Tensor) -> np.ndarray:
    """Return a tensor, float32 or bfloat16 on a CPU, as the array that these kernels take; memory is shared.

    >>> as_array(torch.tensor([1.0, -2.0]).bfloat16()).tolist()
    [16256, -16384]
    """
    return (tensor.view(torch.int16) if tensor.dtype == torch.bfloat16 else tensor).numpy()


def _reinterpreted(source: Any, target: Any, to: Any) -> Any:
    def typed(_: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.bitcast(arguments[0], to)

        return target(source), generate

    return intrinsic(typed)


float_of_bits: Any = _reinterpreted(types.int32, types.float32, ir.FloatType())
"""float_of_bits(bits): return the float32 that has the bits of an int32."""
bits_of_float: Any = _reinterpreted(types.float32, types.int32, ir.IntType(32))
"""bits_of_float(value): return the bits of a float32 as an int32."""


def get(array, row, column):
    """Return `array[row, column]` as a float, in kernels only."""
    raise NotImplementedError


def put(array, row, column, value):
    """Write a float to `array[row, column]`, rounded to the nearest, ties to even; in kernels only."""
    raise NotImplementedError


@overload(get)
def _get(array, row, column):
    if array.dtype == types.int16:
        return lambda array, row, column: float_of_bits(np.int32(array[row, column]) << np.int32(16))
    return lambda array, row, column: array[row, column]


@overload(put)
def _put(array, row, column, value):
    if array.dtype == types.int16:

        def put_value(array, row, column, value):
            bits = bits_of_float(value)
            rounded = bits + HALF_UNIT + ((bits >> np.int32(16)) & np.int32(1))
            array[row, column] = np.int16(rounded >> np.int32(16) if value == value else NAN)
    else:

        def put_value(array, row, column, value):
            array[row, column] = value

    return put_value
