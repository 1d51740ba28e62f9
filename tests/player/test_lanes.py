"""Vectors in registers: the exponential against float64, and reading from many places."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit, types
from numba.extending import intrinsic

from player.lanes import INT, LANES, LONG, gather, load, store


def _address(context: Any, b: Any, kind: Any, array: Any) -> Any:
    return context.make_array(kind)(context, b, array).data


def _exp(_: Any, x: Any, out: Any) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        x, out = (_address(context, b, *pair) for pair in zip(signature.args, arguments, strict=True))
        store(out, LONG(0), load(b, x, LONG(0)).exp())
        return context.get_dummy_value()

    return types.void(x, out), generate


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
gather_lanes: Any = intrinsic(_gather)


@njit
def exp_of(x, out):
    for first in range(0, x.size, LANES):
        exp_lanes(x[first : first + LANES], out[first : first + LANES])


@njit
def gathered(words, index, out):
    gather_lanes(words, index, out)


def test_exp_is_that_of_float64() -> None:
    random = np.random.default_rng(0)
    x = np.concatenate([random.uniform(-87, 88.7, 16_000), random.normal(0, 1e-3, 1_584)]).astype(np.float32)
    found = np.empty_like(x)
    exp_of(x, found)
    np.testing.assert_allclose(found, np.exp(x.astype(np.float64)), rtol=2.5e-7)


@pytest.mark.parametrize("value", [-0.0, 0.0, -95.0, -103.0, -104.5, -1e30, 89.5, 1e30, np.inf, -np.inf])
def test_exp_at_the_ends_of_float32(value: float) -> None:
    x, found = np.full(LANES, value, np.float32), np.empty(LANES, np.float32)
    exp_of(x, found)
    with np.errstate(over="ignore", under="ignore"):
        wanted = np.exp(x.astype(np.float64)).astype(np.float32)
    np.testing.assert_allclose(found, wanted, rtol=2.5e-7, atol=1.5e-45)


def test_exp_of_no_number_is_none() -> None:
    found = np.empty(LANES, np.float32)
    exp_of(np.full(LANES, np.nan, np.float32), found)
    assert np.isnan(found).all()


def test_lanes_read_where_they_are_told_to() -> None:
    words = np.arange(-50, 50, dtype=np.int32)
    index = np.random.default_rng(1).integers(0, 99, LANES).astype(np.int32)
    index[::5] = -1
    found = np.empty((2, LANES), np.int32)
    gathered(words, index, found)
    held = index >= 0
    assert (found[0] == np.where(held, words[index], 0)).all()
    assert (found[1] == np.where(held, words[index + 1], 0)).all()
