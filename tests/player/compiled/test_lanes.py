"""Tests of vectors in registers: exp, sine and cosine against float64, gathering, and fused multiply-add."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit, types
from numba.extending import intrinsic

from player.compiled.lanes import INT, LANES, LONG, gather, load, store
from tests.numerics.bounds import Row

EXP = Row(
    "Density and optical depth", "exp in the compiled march", "all of float32", 2.5e-7,
    "of it, and the least subnormal number", "0 below -104, infinite above 88.7; NaN stays NaN",
)  # fmt: skip
SIN_COS = Row(
    "Field", "sine and cosine in the compiled march", "angles to ±900", 1.2e-7,
    at_ends="beside quarters of a turn; infinite angles and NaN give NaN",
)  # fmt: skip
SMALL_SINE = Row("Field", "sine of a small angle in the compiled march", "below 1e-3", 2e-7, "of it")


def _address(context: Any, b: Any, kind: Any, array: Any) -> Any:
    return context.make_array(kind)(context, b, array).data


def _exp(_: Any, x: Any, out: Any) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        x, out = (_address(context, b, *pair) for pair in zip(signature.args, arguments, strict=True))
        store(out, LONG(0), load(b, x, LONG(0)).exp())
        return context.get_dummy_value()

    return types.void(x, out), generate


def _sin_cos(_: Any, x: Any, out: Any) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        x, out = (_address(context, b, *pair) for pair in zip(signature.args, arguments, strict=True))
        for number, found in enumerate(load(b, x, LONG(0)).sin_cos()):
            store(out, LONG(number * LANES), found)
        return context.get_dummy_value()

    return types.void(x, out), generate


def _fma(_: Any, x: Any, y: Any, out: Any) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        x, y, out = (_address(context, b, *pair) for pair in zip(signature.args, arguments, strict=True))
        first, second = load(b, x, LONG(0)), load(b, y, LONG(0))
        store(out, LONG(0), first.call("fma", second, load(b, out, LONG(0))))
        return context.get_dummy_value()

    return types.void(x, y, out), generate


def _gather(_: Any, words: Any, index: Any, out: Any) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        words, index, out = (
            _address(context, b, *pair) for pair in zip(signature.args, arguments, strict=True)
        )
        at = load(b, index, LONG(0), INT)
        low, high = gather(words, at, 4, at >= 0, LONG).halves()
        store(out, LONG(0), low)
        store(out, LONG(LANES), high)
        return context.get_dummy_value()

    return types.void(words, index, out), generate


exp_lanes: Any = intrinsic(_exp)
sin_cos_lanes: Any = intrinsic(_sin_cos)
fma_lanes: Any = intrinsic(_fma)
gather_lanes: Any = intrinsic(_gather)


@njit
def exp_of(x, out):
    for first in range(0, x.size, LANES):
        exp_lanes(x[first : first + LANES], out[first : first + LANES])


@njit
def sin_cos_of(x, out):
    for number in range(out.shape[0]):
        sin_cos_lanes(x[number * LANES : (number + 1) * LANES], out[number])


@njit
def fused(x, y, out):
    fma_lanes(x, y, out)


@njit
def gathered(words, index, out):
    gather_lanes(words, index, out)


def test_exp_is_that_of_float64() -> None:
    random = np.random.default_rng(0)
    x = np.concatenate([random.uniform(-87, 88.7, 16_000), random.normal(0, 1e-3, 1_584)]).astype(np.float32)
    found = np.empty_like(x)
    exp_of(x, found)
    wanted = np.exp(x.astype(np.float64))
    EXP.check(found, wanted, of=wanted)


@pytest.mark.parametrize("value", [-0.0, 0.0, -95.0, -103.0, -104.5, -1e30, 89.5, 1e30, np.inf, -np.inf])
def test_exp_at_the_ends_of_float32(value: float) -> None:
    x, found = np.full(LANES, value, np.float32), np.empty(LANES, np.float32)
    exp_of(x, found)
    with np.errstate(over="ignore", under="ignore"):
        wanted = np.exp(x.astype(np.float64)).astype(np.float32)
    EXP.check(found, wanted, of=wanted.astype(np.float64) + 1.5e-45 / EXP.bound)


def test_exp_of_no_number_is_none() -> None:
    found = np.empty(LANES, np.float32)
    exp_of(np.full(LANES, np.nan, np.float32), found)
    EXP.holds(np.isnan(found))


def test_sin_and_cos_are_those_of_float64() -> None:
    """Sine and cosine are right to two roundings of float32, at all angles of a ray through contracted space
    and beyond, also near quarters of a turn, where the two change places."""
    random = np.random.default_rng(0)
    quarters = (np.arange(-40, 41) * (np.pi / 4)).astype(np.float32)
    small = np.array([0, -0.0, 1e-45, -1e-38, 1e-20, 3e-5, np.nextafter(np.float32(1), 2)], np.float32)
    parts = random.uniform(-4, 4, 8_000), random.uniform(-900, 900, 2_000), quarters, small
    x = np.concatenate([part.astype(np.float32) for part in parts])
    x = np.resize(x, len(x) // LANES * LANES + LANES)
    found = np.empty((len(x) // LANES, 2, LANES), np.float32)
    sin_cos_of(x, found)
    for number, function in enumerate((np.sin, np.cos)):
        wanted = function(x.astype(np.float64))
        SIN_COS.check(found[:, number].reshape(-1), wanted)
    sines, tiny = found[:, 0].reshape(-1), np.abs(x) < 1e-3
    wanted = np.sin(x[tiny].astype(np.float64))
    SMALL_SINE.check(sines[tiny], wanted, of=np.abs(wanted) + 1e-44 / SMALL_SINE.bound)
    for value in (np.nan, np.inf):
        sin_cos_of(np.full(LANES, value, np.float32), found[:1])
        assert np.isnan(found[0]).all()


def test_lanes_read_where_they_are_told_to() -> None:
    words = np.arange(-50, 50, dtype=np.int32)
    index = np.random.default_rng(1).integers(0, 99, LANES).astype(np.int32)
    index[::5] = -1
    found = np.empty((2, LANES), np.int32)
    gathered(words, index, found)
    held = index >= 0
    assert (found[0] == np.where(held, words[index], 0)).all()
    assert (found[1] == np.where(held, words[index + 1], 0)).all()


def test_multiply_and_add_are_rounded_once() -> None:
    """Multiply-add is rounded once, also without an instruction for it: then the C library's is called."""
    random = np.random.default_rng(1)
    for _ in range(100):
        x, y = random.normal(size=(2, LANES)).astype(np.float32)
        z = (-x * y).astype(np.float32)  # the sum is what rounding the product to float32 has lost
        out = z.copy()
        fused(x, y, out)
        exact = x.astype(np.float64) * y + z  # products of float32, and this sum, are exact in float64
        np.testing.assert_array_equal(out, exact.astype(np.float32))
        assert np.abs(exact).max() > 0
