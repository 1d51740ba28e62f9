"""From the numbers of a head to a program: the instructions that `player.head.compiled` runs.

A value of the head is a table in memory of BLOCK pixels by its width, padded to whole tiles. All places and
sizes follow from the widths that `player.head.graph` has checked. What is rounded to 8 bits is kept in bytes
where the processor multiplies those (`player.head.dense_tiles`); elsewhere codes are kept as floats, whose
sums of products are the same integers, added up more slowly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from player.head.activations import GELU, LINEAR, SIGMOID
from player.head.dense_tiles import MOST_BYTES, MULTIPLIES_BYTES, QUAD, ROWS, WIDTH
from player.head.graph import HeadArrays, Layer, Rounding, monomials

BLOCK = 4 * ROWS
"""Pixels at a time: all the numbers of a 64 wide head are then 300 kB."""
DENSE, DENSE_CODES, DENSE_BYTES, MULTIPLY, MONOMIALS, QUANTIZE, ROUND = range(7)


@dataclass(frozen=True)
class Value:
    """A table of BLOCK pixels: its first number in memory, numbers from a pixel to the next, and how many of
    them count. `in_bytes`: it is among the bytes, not the floats."""

    place: int
    pitch: int
    width: int
    in_bytes: bool = False


@dataclass(frozen=True)
class Program:
    """Instructions, what they read, and where the head's inputs and its output are in memory."""

    steps: np.ndarray
    """[n, 12] int64; what the numbers mean, `player.head.compiled` knows."""
    weights: np.ndarray
    packed: np.ndarray
    """int8 weights as `dense_bytes_tile` takes them."""
    starts: np.ndarray
    """int32 that its sums begin with."""
    pairs: np.ndarray
    """[n_monomials, 2] int64: of which monomial, -1 for 1, and which of x, y and z each is the product."""
    n_floats: int
    n_bytes: int
    features: Value
    dirs: Value
    rgb: Value


def program_of(head: HeadArrays, in_bytes: bool = MULTIPLIES_BYTES) -> Program:
    """The program of a head. `in_bytes`: whether the processor multiplies bytes."""
    return _Compiler(head, in_bytes).program()


class _Compiler:
    def __init__(self, head: HeadArrays, in_bytes: bool) -> None:
        self._head = head
        self._in_bytes = in_bytes
        self._weights = _Constants(np.float32)
        self._packed = _Constants(np.int8)
        self._starts = _Constants(np.int32)
        self._n_floats = self._n_bytes = 0
        self._steps: list[tuple[int, ...]] = []

    def program(self) -> Program:
        head = self._head
        features, dirs = self._floats(head.n_channels), self._floats(3)
        roundings = iter(head.roundings)
        h = features
        for layer in head.spatial:
            h = self._dense(h, layer, GELU)
        h, of_h = self._rounded(h, next(roundings, None))
        encoded = self._dense(h, head.to_sh, rounding=of_h)
        self._multiply(encoded, self._harmonics(dirs))
        z = self._dense(h, head.bottleneck, rounding=of_h)
        z = self._dense(encoded, Layer(head.from_sh, np.zeros(0)), GELU, start=z)
        for layer in head.directional:
            z, of_z = self._rounded(z, next(roundings, None))
            z = self._dense(z, layer, GELU, rounding=of_z)
        rgb = self._dense(z, head.output, SIGMOID)
        pairs = [pair for order in range(1, head.form.sh_degree) for pair in _pairs(order)]
        return Program(
            np.array(self._steps, np.int64), self._weights.joined(), self._packed.joined(),
            self._starts.joined(), np.array(pairs, np.int64).reshape(-1, 2), self._n_floats, self._n_bytes,
            features, dirs, rgb,
        )  # fmt: skip

    def _floats(self, width: int) -> Value:
        value = Value(self._n_floats, _padded(width), width)
        self._n_floats += BLOCK * value.pitch
        return value

    def _step(self, *numbers: int) -> None:
        self._steps.append((*numbers, *[0] * (12 - len(numbers))))

    def _dense(
        self,
        x: Value,
        layer: Layer,
        activation: int = LINEAR,
        rounding: Rounding | None = None,
        start: Value | None = None,
    ) -> Value:
        """A layer of `x`; its sums begin with the bias, or with the rows of `start`."""
        width = layer.weight.shape[1]
        out = self._floats(width)
        if rounding is not None:
            self._dense_rounded(x, layer, rounding, out, activation)
            return out
        first = (start.place, start.pitch, 1) if start else (self._weights.add(layer.bias[None]), 0, 0)
        self._step(
            DENSE, x.place, x.pitch, self._weights.add(layer.weight), _padded(width), *first,
            out.place, out.pitch, x.width, activation,
        )  # fmt: skip
        return out

    def _dense_rounded(self, x: Value, layer: Layer, rounding: Rounding, out: Value, activation: int) -> None:
        """A layer of codes: the code of 0 is in what the sums begin with, in bytes, or in `x`, in floats."""
        codes, bias, width = layer.weight, layer.bias, out.width
        assert layer.scale is not None
        scale = self._weights.add(layer.scale[None])
        if not x.in_bytes:
            self._step(
                DENSE_CODES, x.place, x.pitch, self._weights.add(codes), _padded(width),
                self._weights.add(bias[None]), 0, scale, out.place, out.pitch, x.width, activation,
            )  # fmt: skip
            return
        starts = bias - rounding.zero * codes.sum(axis=0, dtype=np.int64)
        n_quads, tiles = -(-x.width // QUAD), _padded(width) // WIDTH
        table = np.zeros((n_quads * QUAD, tiles * WIDTH), np.int8)
        table[: x.width, :width] = codes
        table = table.reshape(n_quads, QUAD, tiles, WIDTH).transpose(2, 0, 3, 1)
        self._step(
            DENSE_BYTES, x.place, 0, self._packed.add(table.reshape(1, -1)), self._starts.add(starts[None]),
            scale, 0, 0, out.place, out.pitch, n_quads, activation,
        )  # fmt: skip

    def _multiply(self, a: Value, b: Value) -> None:
        """In place, in `a`."""
        self._step(MULTIPLY, a.place, a.pitch, b.place)

    def _harmonics(self, dirs: Value) -> Value:
        weight = self._head.harmonics.weight
        terms = self._floats(len(weight))
        self._step(MONOMIALS, dirs.place, dirs.pitch, 0, 0, 0, 0, 0, terms.place, terms.pitch)
        return self._dense(terms, self._head.harmonics)

    def _rounded(self, x: Value, rounding: Rounding | None) -> tuple[Value, Rounding | None]:
        """`x` as codes, in bytes or in floats, from which the code of 0 is taken off."""
        if rounding is None:
            return x, None
        numbers = self._weights.add(np.array([[1 / rounding.scale]], np.float32))
        if self._in_bytes and x.width <= MOST_BYTES:
            out = Value(self._n_bytes, MOST_BYTES, x.width, in_bytes=True)
            self._n_bytes += BLOCK * MOST_BYTES
        else:
            out = self._floats(x.width)
        kind = QUANTIZE if out.in_bytes else ROUND
        self._step(kind, x.place, x.pitch, numbers, rounding.zero, 0, 0, 0, out.place)
        return out, rounding


def _pairs(order: int) -> list[tuple[int, int]]:
    """What the monomials of an order are products of, by their places among those of all orders from 1 on."""
    _, parents, axes = monomials(order)
    below = sum(k * (k + 1) // 2 for k in range(2, order))  # monomials of the orders before the one below
    return [(below + parent if order > 1 else -1, axis) for parent, axis in zip(parents, axes, strict=True)]


class _Constants:
    """Numbers of one kind after one another, rows padded with zeros to whole tiles."""

    def __init__(self, kind: Any) -> None:
        self._kind = kind
        self._parts: list[np.ndarray] = []
        self._size = 0

    def add(self, rows: np.ndarray) -> int:
        """Where they begin."""
        padded = np.zeros((len(rows), _padded(rows.shape[1])), self._kind)
        padded[:, : rows.shape[1]] = rows
        self._parts.append(padded.reshape(-1))
        self._size += padded.size
        return self._size - padded.size

    def joined(self) -> np.ndarray:
        return np.concatenate(self._parts) if self._parts else np.zeros(0, self._kind)


def _padded(width: int) -> int:
    return -(-width // WIDTH) * WIDTH
