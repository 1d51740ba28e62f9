"""Weighted sums of eight rows of features: 8-bit codes are unpacked in registers, CHANNELS at a time.

The compiler does not vectorise a loop over, say, ten channels of eight rows: it cannot know that the sum lies
elsewhere in memory than the rows, and ten numbers are fewer than one register holds. Only compiled code
imports this module.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

CHANNELS = 16
"""Channels that are read at a time. Where fewer are left, the bytes behind them in memory are read, too."""

_FLOATS = ir.VectorType(ir.FloatType(), CHANNELS)
_CODES = ir.VectorType(ir.IntType(8), CHANNELS)
_FIRST_LANE = ir.Constant(ir.VectorType(ir.IntType(32), CHANNELS), [0] * CHANNELS)


def _add_rows(
    _: Any, features: Any, rows: Any, shares: Any, which: Any, out: Any, row: Any, first: Any
) -> Any:
    stored, align = (_CODES, 1) if features.dtype == types.int8 else (_FLOATS, 4)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:

        def address(index: int, at: list[Any]) -> Any:
            kind = signature.args[index]
            array = context.make_array(kind)(context, builder, arguments[index])
            return cgutils.get_item_pointer(context, builder, kind, array, at)

        def vector(index: int, at: list[Any], kind: ir.VectorType) -> Any:
            return builder.bitcast(address(index, at), ir.PointerType(kind))

        terms = []
        for corner in range(8):
            at = [context.get_constant(types.intp, corner), arguments[3]]
            number = builder.sext(builder.load(address(1, at)), ir.IntType(64))
            loaded = builder.load(vector(0, [number, arguments[6]], stored), align=align)
            values = builder.sitofp(loaded, _FLOATS) if stored is _CODES else loaded
            share = builder.load(address(2, at))
            one = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), share, ir.IntType(32)(0))
            every = builder.shuffle_vector(one, ir.Constant(_FLOATS, ir.Undefined), _FIRST_LANE)
            terms.append(builder.fmul(values, every))
        while len(terms) > 1:
            terms = [builder.fadd(a, b) for a, b in zip(terms[::2], terms[1::2], strict=True)]
        place = vector(4, [arguments[5], arguments[6]], _FLOATS)
        builder.store(builder.fadd(builder.load(place, align=4), terms[0]), place, align=4)
        return context.get_dummy_value()

    arrays = (features, rows, shares, types.intp, out, types.intp, types.intp)
    return types.void(*arrays), generate


add_rows: Any = intrinsic(_add_rows)
"""add_rows(features [n, n_channels] int8 or float32, rows [8, m] int32, shares [8 or more, m] float32, which,
out [n_out, width] float32, row, first): add up the eight rows of `features` that column `which` of `rows`
names, weighted by column `which` of `shares`, and add the sum to `out[row]`: CHANNELS channels from `first`
on.

CHANNELS values are read and as many sums are written whatever n_channels is, so that both must be inside
their arrays. Sums beyond n_channels have no meaning.
"""
