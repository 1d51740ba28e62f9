"""Prefetching: asking for memory before it is needed.

The rows of a hash table or of a grid that one sample or one step reads are scattered over memory, and a core
that reads them one by one waits for each. If all are prefetched first, they arrive side by side. Only
compiled code imports this module.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

READ, KEEP, DATA = 0, 3, 1
"""Arguments of LLVM's prefetch: for reading, to be kept in all caches, data and not code."""


def _prefetch(typing_context: Any, array: Any, row: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array_type, row_type = signature.args
        view = context.make_array(array_type)(context, builder, arguments[0])
        index = context.cast(builder, arguments[1], row_type, types.intp)
        at = [index] + [context.get_constant(types.intp, 0)] * (array_type.ndim - 1)
        address = cgutils.get_item_pointer(context, builder, array_type, view, at)
        byte, word = ir.PointerType(ir.IntType(8)), ir.IntType(32)
        hint = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [byte, word, word, word]), "llvm.prefetch.p0i8"
        )
        builder.call(hint, [builder.bitcast(address, byte), word(READ), word(KEEP), word(DATA)])
        return context.get_dummy_value()

    return types.void(array, row), generate


prefetch: Any = intrinsic(_prefetch)
"""prefetch(array, row): prefetch the start of a row of an array; no value changes."""
