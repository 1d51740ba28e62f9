"""A tile of a dense layer, activation and all, in registers: what `player.head_compiled` is made of.

A tile is ROWS pixels by two vectors of LANES outputs, as much as the processor's registers hold. Its sums
never leave them before the activation is applied, where a library writes the products, reads them for the
bias, and reads them again for the GELU. Compiled code alone imports this.

    gelu(x) = x (1 + erf(x / sqrt 2)) / 2, erf by the rational function of Eigen: to 3e-7
    sigmoid(x) = 1 / (1 + exp(-x)), exp by the polynomial of Cephes: to 2e-7
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from player.lanes import EXP, LANES

ROWS = 12 if LANES == 16 else 6
"""32 registers of 16 numbers, or half as many of half as many: two vectors a row, and some to spare."""
WIDTH = 2 * LANES
"""Outputs of a tile."""
LINEAR, GELU, SIGMOID = range(3)

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_NOTHING = ir.Constant(_FLOATS, ir.Undefined)
_FIRST_LANE = ir.Constant(_INTS, [0] * LANES)

# erf(z) = z P(z^2) / Q(z^2) for |z| <= 4, highest power first; Q > 0
_ERF_P = (
    2.72614225801306e-10, -2.77068142495902e-08, 2.10102402082508e-06, 5.69250639462346e-05,
    7.34990630326855e-04, 2.95459980854025e-03, 1.60960333262415e-02,
)  # fmt: skip
_ERF_Q = (
    1.45660718464996e-05, 2.13374055278905e-04, 1.68282697438203e-03, 7.37332916720468e-03,
    1.42647390514189e-02,
)  # fmt: skip


class _Vectors:
    """Arithmetic on vectors, in the order in which it is written."""

    def __init__(self, builder: Any) -> None:
        self.b = builder

    def constant(self, value: float) -> Any:
        return ir.Constant(_FLOATS, [float(np.float32(value))] * LANES)

    def call(self, name: str, *values: Any) -> Any:
        kind = ir.FunctionType(_FLOATS, [_FLOATS] * len(values))
        name = f"llvm.{name}.v{LANES}f32"
        return self.b.call(cgutils.get_or_insert_function(self.b.module, kind, name), values)

    def splat(self, value: Any) -> Any:
        one = self.b.insert_element(_NOTHING, value, ir.IntType(32)(0))
        return self.b.shuffle_vector(one, _NOTHING, _FIRST_LANE)

    def polynomial(self, coefficients: tuple[float, ...], x: Any) -> Any:
        value = self.constant(coefficients[0])
        for coefficient in coefficients[1:]:
            value = self.call("fma", value, x, self.constant(coefficient))
        return value

    def inverse(self, x: Any) -> Any:
        """1 / x of ordinary numbers, in half the time of a division: a guess from the bits, 5 % wrong, and
        three steps of Newton, each of which squares what is wrong."""
        bits = self.b.sub(ir.Constant(_INTS, [0x7EF311C7] * LANES), self.b.bitcast(x, _INTS))
        guess = self.b.bitcast(bits, _FLOATS)
        for _ in range(3):
            wrong = self.call("fma", self.b.fneg(x), guess, self.constant(2))
            guess = self.b.fmul(guess, wrong)
        return guess

    def gelu(self, x: Any) -> Any:
        z = self.b.fmul(x, self.constant(0.5**0.5))
        z = self.call("minnum", self.call("maxnum", z, self.constant(-4)), self.constant(4))
        square = self.b.fmul(z, z)
        below = self.inverse(self.polynomial(_ERF_Q, square))
        erf = self.b.fmul(self.b.fmul(z, self.polynomial(_ERF_P, square)), below)
        half = self.b.fmul(x, self.constant(0.5))
        return self.call("fma", half, erf, half)

    def sigmoid(self, x: Any) -> Any:
        y = self.call("minnum", self.call("maxnum", self.b.fneg(x), self.constant(-87)), self.constant(87))
        power = self.call("rint", self.b.fmul(y, self.constant(np.log2(np.e))))
        rest = self.call("fma", power, self.constant(-0.693359375), y)
        rest = self.call("fma", power, self.constant(2.12194440e-4), rest)
        bits = self.b.add(self.b.fptosi(power, _INTS), ir.Constant(_INTS, [127] * LANES))
        scale = self.b.bitcast(self.b.shl(bits, ir.Constant(_INTS, [23] * LANES)), _FLOATS)
        exp = self.b.fmul(self.polynomial(EXP, rest), scale)
        value = self.b.fdiv(self.constant(1), self.b.fadd(self.constant(1), exp))
        return self.b.select(self.b.fcmp_unordered("uno", x, x), x, value)  # what is no number stays none


def _tile(
    _: Any, memory: Any, weights: Any, x: Any, w: Any, start: Any, out: Any, depth: Any, act: Any
) -> Any:

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vectors = _Vectors(builder)

        def base(index: int) -> Any:
            return context.make_array(signature.args[index])(context, builder, arguments[index]).data

        def pair(index: int) -> tuple[Any, Any]:
            return tuple(builder.extract_value(arguments[index], i) for i in range(2))  # type: ignore[return-value]

        def place(array: Any, at: Any) -> Any:
            return builder.bitcast(builder.gep(array, [at]), ir.PointerType(_FLOATS))

        here, there = base(0), base(1)
        (x_at, x_pitch), (w_at, w_pitch), (out_at, out_pitch) = pair(2), pair(3), pair(5)
        starts_in_memory = builder.icmp_signed(
            "!=", builder.extract_value(arguments[4], 2), ir.IntType(64)(0)
        )
        first = builder.select(starts_in_memory, here, there)
        start_at, start_pitch = pair(4)
        size = ir.IntType(64)
        sums = [[cgutils.alloca_once(builder, _FLOATS) for _ in range(2)] for _ in range(ROWS)]
        for row in range(ROWS):
            at = builder.add(start_at, builder.mul(start_pitch, size(row)))
            for half in range(2):
                value = builder.load(place(first, builder.add(at, size(half * LANES))), align=4)
                builder.store(value, sums[row][half])
        x_rows = [builder.gep(here, [builder.add(x_at, builder.mul(x_pitch, size(r)))]) for r in range(ROWS)]
        with cgutils.for_range(builder, arguments[6]) as loop:
            at = builder.add(w_at, builder.mul(w_pitch, loop.index))
            columns = [
                builder.load(place(there, builder.add(at, size(half * LANES))), align=4) for half in range(2)
            ]
            for row in range(ROWS):
                value = vectors.splat(builder.load(builder.gep(x_rows[row], [loop.index])))
                for half in range(2):
                    total = vectors.call("fma", value, columns[half], builder.load(sums[row][half]))
                    builder.store(total, sums[row][half])

        def finish(function: Any) -> None:
            for row in range(ROWS):
                at = builder.add(out_at, builder.mul(out_pitch, size(row)))
                for half in range(2):
                    value = function(builder.load(sums[row][half]))
                    builder.store(value, place(here, builder.add(at, size(half * LANES))), align=4)

        is_gelu, is_sigmoid = (
            builder.icmp_signed("==", arguments[7], arguments[7].type(kind)) for kind in (GELU, SIGMOID)
        )
        with builder.if_else(is_gelu) as (then, otherwise):
            with then:
                finish(vectors.gelu)
            with otherwise, builder.if_else(is_sigmoid) as (then, otherwise):
                with then:
                    finish(vectors.sigmoid)
                with otherwise:
                    finish(lambda value: value)
        return context.get_dummy_value()

    two, three = types.UniTuple(types.int64, 2), types.UniTuple(types.int64, 3)
    return types.void(memory, weights, two, two, three, two, types.int64, types.int64), generate


dense_tile: Any = intrinsic(_tile)
"""dense_tile(memory, weights, x, w, start, out, depth, activation): ROWS by WIDTH outputs of one layer.

`memory` and `weights` are flat float32. x, w, out: (index of the first number, numbers from row to row), w in
`weights`, the others in `memory`. start: the same, and whether it is in `memory` rather than in `weights`;
what the sums begin with, a bias with 0 from row to row. depth: inputs of the layer.
"""


def _multiply(_: Any, memory: Any, out: Any, a: Any, b: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        to, *factors = (
            builder.bitcast(builder.gep(array, [at]), ir.PointerType(_FLOATS)) for at in arguments[1:]
        )
        one, other = (builder.load(factor, align=4) for factor in factors)
        builder.store(builder.fmul(one, other), to, align=4)
        return context.get_dummy_value()

    return types.void(memory, types.int64, types.int64, types.int64), generate


multiply_lanes: Any = intrinsic(_multiply)
"""multiply_lanes(memory, out, a, b): LANES numbers at `out` become the products of those at `a` and `b`.

The compiler does not do so by itself: it cannot know that the three do not overlap.
"""
