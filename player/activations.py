"""What follows a layer, on vectors of numbers in registers. Compiled code alone imports this.

    gelu(x) = x (1 + erf(x / sqrt 2)) / 2, erf by the rational function of Eigen: to 3e-7
    sigmoid(x) = 1 / (1 + exp(-x))
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir

from player.lanes import INT, Lanes, choose, vector

LINEAR, GELU, SIGMOID = range(3)

# erf(z) = z P(z^2) / Q(z^2) for |z| <= 4, highest power first; Q > 0
_ERF_P = (
    2.72614225801306e-10, -2.77068142495902e-08, 2.10102402082508e-06, 5.69250639462346e-05,
    7.34990630326855e-04, 2.95459980854025e-03, 1.60960333262415e-02,
)  # fmt: skip
_ERF_Q = (
    1.45660718464996e-05, 2.13374055278905e-04, 1.68282697438203e-03, 7.37332916720468e-03,
    1.42647390514189e-02,
)  # fmt: skip


def activated(builder: Any, kind: Any, write: Callable[[Callable[[Lanes], Lanes]], None]) -> None:
    """Have `write` write everything as the activation `kind`, a number known when it runs, makes it."""
    is_gelu, is_sigmoid = (
        builder.icmp_signed("==", kind, ir.Constant(kind.type, number)) for number in (GELU, SIGMOID)
    )
    with builder.if_else(is_gelu) as (then, otherwise):
        with then:
            write(gelu)
        with otherwise, builder.if_else(is_sigmoid) as (then, otherwise):
            with then:
                write(sigmoid)
            with otherwise:
                write(lambda x: x)


def gelu(x: Lanes) -> Lanes:
    z = (x * 0.5**0.5).most(-4).least(4)
    square = z * z
    erf = z * _polynomial(_ERF_P, square) * _inverse(_polynomial(_ERF_Q, square))
    half = x * 0.5
    return half.call("fma", erf, half)


def sigmoid(x: Lanes) -> Lanes:
    """What is no number stays none."""
    y = (-x).most(-87).least(87)
    return choose(Lanes(x.b, x.b.fcmp_unordered("uno", x.value, x.value)), x, 1.0 / (y.exp() + 1))


def _polynomial(coefficients: tuple[float, ...], x: Lanes) -> Lanes:
    total = x.like(coefficients[0])
    for coefficient in coefficients[1:]:
        total = total.call("fma", x, coefficient)
    return total


def _inverse(x: Lanes) -> Lanes:
    """1 / x of ordinary numbers, in half the time of a division: a guess from the bits, 5 % wrong, and three
    steps of Newton, each of which squares what is wrong."""
    bits = Lanes(x.b, x.b.bitcast(x.value, vector(INT)))
    guess = (0x7EF311C7 - bits).as_float()
    for _ in range(3):
        guess = guess * (-x).call("fma", guess, 2.0)
    return guess
