"""Activations and roundings of a layer's outputs, on vectors of numbers in registers. Only compiled code
imports this module.

They run as a separate pass over numbers that are still in cache. Each takes dozens of operations that depend
on one another; in a short loop over vectors, the processor overlaps those of many vectors.

    gelu(x) = x (1 + erf(x / sqrt 2)) / 2, erf by the rational function of Eigen: to 3e-7
    hard_swish(x) = x min(max(x / 6 + 1/2, 0), 1)
    sigmoid(x) = 1 / (1 + exp(-x))
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from player.compiled.lanes import BYTE, FLOAT, INT, Lanes, address, choose, load, splat, store, vector

LINEAR, GELU, HARD_SWISH = range(3)

# erf(z) = z P(z^2) / Q(z^2) for |z| <= 4, highest power first; Q > 0
_ERF_P = (
    2.72614225801306e-10, -2.77068142495902e-08, 2.10102402082508e-06, 5.69250639462346e-05,
    7.34990630326855e-04, 2.95459980854025e-03, 1.60960333262415e-02,
)  # fmt: skip
_ERF_Q = (
    1.45660718464996e-05, 2.13374055278905e-04, 1.68282697438203e-03, 7.37332916720468e-03,
    1.42647390514189e-02,
)  # fmt: skip


def _gelu(x: Lanes) -> Lanes:
    z = _within(x * 0.5**0.5, 4.0)
    square = z * z
    erf = z * _polynomial(_ERF_P, square) * _inverse(_polynomial(_ERF_Q, square))
    half = x * 0.5
    return half.call("fma", erf, half)


def _hard_swish(x: Lanes) -> Lanes:
    return x * x.call("fma", 1 / 6, 0.5).most(0).least(1)


def _within(x: Lanes, most: float) -> Lanes:
    """Clamp numbers to -most and most; NaN stays NaN."""
    x = choose(x < -most, x.like(-most), x)
    return choose(x > most, x.like(most), x)


def _sigmoid(x: Lanes) -> Lanes:
    """Return 1 / (1 + exp(-x)); NaN stays NaN."""
    y = (-x).most(-87).least(87)
    return choose(Lanes(x.b, x.b.fcmp_unordered("uno", x.value, x.value)), x, 1.0 / (y.exp() + 1))


def _polynomial(coefficients: tuple[float, ...], x: Lanes) -> Lanes:
    total = x.like(coefficients[0])
    for coefficient in coefficients[1:]:
        total = total.call("fma", x, coefficient)
    return total


def _inverse(x: Lanes) -> Lanes:
    """Return 1 / x of ordinary numbers, in half the time of a division.

    The bits give a guess that is 5 % wrong; each of three steps of Newton's method squares the relative
    error.
    """
    bits = Lanes(x.b, x.b.bitcast(x.value, vector(INT)))
    guess = (0x7EF311C7 - bits).as_float()
    for _ in range(3):
        guess = guess * (-x).call("fma", guess, 2.0)
    return guess


def _in_place(function: Callable[[Lanes], Lanes]) -> Any:

    def typed(_: Any, memory: Any, at: Any) -> Any:

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            array = address(context, builder, signature.args[0], arguments[0])
            store(array, arguments[1], function(load(builder, array, arguments[1])))
            return context.get_dummy_value()

        return types.void(memory, types.int64), generate

    return intrinsic(typed)


gelu_lanes: Any = _in_place(_gelu)
"""gelu_lanes(memory, at): replace LANES numbers of `memory` [n] float32, from index `at` on, by their
GELU."""
hard_swish_lanes: Any = _in_place(_hard_swish)
"""hard_swish_lanes(memory, at): replace LANES numbers of `memory`, from index `at` on, by their hard
swish."""
sigmoid_lanes: Any = _in_place(_sigmoid)
"""sigmoid_lanes(memory, at): replace LANES numbers of `memory`, from index `at` on, by their sigmoid."""


def _quantize(_: Any, codes: Any, memory: Any, out: Any, x: Any, zero: Any, per_step: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        there, here = (address(context, builder, signature.args[n], arguments[n]) for n in range(2))
        code = _code(load(builder, here, arguments[3]), *arguments[4:])
        narrow = vector(BYTE)
        place = builder.bitcast(builder.gep(there, [arguments[2]]), ir.PointerType(narrow))
        builder.store(builder.trunc(code.to_int().value, narrow), place, align=1)
        return context.get_dummy_value()

    long = types.int64
    return types.void(codes, memory, long, long, long, types.float32), generate


quantize_lanes: Any = intrinsic(_quantize)
"""quantize_lanes(codes, memory, out, x, zero, per_step): write LANES numbers of `memory`, from index `x` on,
as 8-bit codes to `codes` [n] uint8, from index `out` on. `zero`: the code of 0; `per_step`: levels per
unit."""


def _round(_: Any, memory: Any, out: Any, x: Any, zero: Any, per_step: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        here = address(context, builder, signature.args[0], arguments[0])
        _, out, x, zero, per_step = arguments
        levels = _code(load(builder, here, x), zero, per_step) - splat(builder, builder.sitofp(zero, FLOAT))
        store(here, out, levels)
        return context.get_dummy_value()

    long = types.int64
    return types.void(memory, long, long, long, types.float32), generate


round_lanes: Any = intrinsic(_round)
"""round_lanes(memory, out, x, zero, per_step): like `quantize_lanes`, but write the codes minus `zero` as
floats to `memory`, from index `out` on."""


def _code(x: Lanes, zero: Any, per_step: Any) -> Lanes:
    """Return the code of each number, 0 to 255, as a float."""
    shift = splat(x.b, x.b.sitofp(zero, FLOAT))
    return ((x * splat(x.b, per_step)).call("rint") + shift).most(0).least(255)
