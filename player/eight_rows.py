"""Eight rows of features added up at once: 8-bit codes are unpacked in registers, LANES channels at a time.

A loop over ten channels of eight rows is not vectorised by the compiler, which cannot know that the sum lies
elsewhere than the rows, and ten is less than what one register holds. Compiled code alone imports this.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16
"""Channels at a time; fewer are read together with what follows them in memory."""

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_CODES = ir.VectorType(ir.IntType(8), LANES)
_FIRST_LANE = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)


def _add_rows(_: Any, features: Any, rows: Any, shares: Any, out: Any, first: Any) -> Any:
    stored, align = (_CODES, 1) if features.dtype == types.int8 else (_FLOATS, 4)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:

        def address(index: int, at: Any, vector: ir.VectorType) -> Any:
            kind = signature.args[index]
            array = context.make_array(kind)(context, builder, arguments[index])
            place = cgutils.get_item_pointer(context, builder, kind, array, [at, arguments[4]])
            return builder.bitcast(place, ir.PointerType(vector))

        terms = []
        for i in range(8):
            loaded = builder.load(address(0, builder.extract_value(arguments[1], i), stored), align=align)
            values = builder.sitofp(loaded, _FLOATS) if stored is _CODES else loaded
            share = builder.extract_value(arguments[2], i)
            one = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), share, ir.IntType(32)(0))
            every = builder.shuffle_vector(one, ir.Constant(_FLOATS, ir.Undefined), _FIRST_LANE)
            terms.append(builder.fmul(values, every))
        while len(terms) > 1:
            terms = [builder.fadd(a, b) for a, b in zip(terms[::2], terms[1::2], strict=True)]
        place = address(3, context.get_constant(types.int64, 0), _FLOATS)
        builder.store(builder.fadd(builder.load(place, align=4), terms[0]), place, align=4)
        return context.get_dummy_value()

    eight = types.UniTuple(types.int64, 8), types.UniTuple(types.float32, 8)
    return types.void(features, *eight, out, types.int64), generate


add_rows: Any = intrinsic(_add_rows)
"""add_rows(features [n, n_channels] int8 or float32, rows (8 int64), shares (8 float32), out [1, width]
float32, first): add the weighted rows to `out[0]`, LANES channels from `first` on.

LANES values are read and LANES sums written whatever n_channels: both have to be there. Sums beyond
n_channels are of no meaning.
"""
