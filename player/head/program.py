"""From the numbers of a head in 8 bits to a program: the instructions that `player.head.compiled` runs.

Every value of the head is a table in memory of BLOCK pixels by its width, padded to whole vectors. All places
and sizes follow from the widths that `player.head.graph` has checked. What is rounded to 8 bits is kept in
bytes where the processor multiplies those (`player.head.dense_tiles`). Elsewhere codes are kept as floats:
sums of their products are the same integers, added up more slowly. So are those of a head whose weights are
so large that two products do not fit into 16 bits, where the processor adds them up so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from player.head.activations import GELU, HARD_SWISH, LINEAR
from player.head.dense_tiles import ADDS_PAIRS, LANES, MOST_BYTES, MULTIPLIES_BYTES, QUAD, ROWS, UNSCALED
from player.head.graph import PAIR_LIMIT, HeadArrays, Layer, Rounding, monomials, pair_sums

BLOCK = 4 * ROWS
"""Pixels at a time: all the numbers of a 64 wide head are then 150 kB."""
DENSE, DENSE_BYTES, MULTIPLY, ADD, REPEAT, MONOMIALS, QUANTIZE, ROUND = range(8)
"""Kinds of steps."""


class Value(NamedTuple):
    """A table of BLOCK pixels in memory."""

    place: int
    """Index of its first number."""
    pitch: int
    """Numbers from a pixel to the next."""
    width: int
    """Numbers of a pixel that count; the others are padding."""
    in_bytes: bool = False
    """Whether it is among the bytes, not the floats."""


class Step(NamedTuple):
    """One instruction: from the table at `x` to the table at `out`. Places are indices of first numbers."""

    kind: int
    x: int = 0
    x_pitch: int = 0
    depth: int = 0
    """DENSE: inputs of the layer. DENSE_BYTES: QUADs of inputs. REPEAT: numbers of a pixel."""
    w: int = 0
    """Place of the layer's weights."""
    copies: int = 1
    """REPEAT: how often each number is written."""
    start: int = 0
    """Place of what the layer's sums begin with."""
    start_pitch: int = 0
    """Numbers from that of a pixel to that of the next; 0 where all pixels begin alike."""
    starts_in_memory: int = 0
    """1 where the sums begin with a table in memory, 0 where with a bias among the weights."""
    scale: int = 0
    """Place of what the layer's sums are multiplied by, or UNSCALED. QUANTIZE, ROUND: of levels in a unit."""
    zero: int = 0
    """QUANTIZE, ROUND: the code of 0."""
    out: int = 0
    """MULTIPLY, ADD: place of the table that `x` is multiplied with or added to. MULTIPLY: rows of `x` may be
    shorter, and begin again."""
    pitch: int = 0
    activation: int = LINEAR


STEP = np.dtype([(name, np.int64) for name in Step._fields])
"""A `Step` as compiled code reads it."""


@dataclass(frozen=True)
class Program:
    """Instructions, what they read, and where the head's inputs and its output are in memory."""

    steps: np.ndarray
    """[n_steps] STEP."""
    weights: np.ndarray
    """[n] float32 weights, biases and scales."""
    packed: np.ndarray
    """[n] int8 weights as `dense_bytes_tile` takes them."""
    starts: np.ndarray
    """[n] int32 that the sums of `dense_bytes_tile` begin with."""
    pairs: np.ndarray
    """[n_monomials, 2] int64: the monomial, -1 for 1, and the axis, 0 to 2, that each is the product of."""
    n_floats: int
    """Numbers of memory that the tables in floats take."""
    n_bytes: int
    """Bytes that the tables in bytes take."""
    features: Value
    dirs: Value
    rgb: Value
    """Whose sigmoid is the colour."""


def program_of(head: HeadArrays, in_bytes: bool = MULTIPLIES_BYTES) -> Program:
    """The program of a head in 8 bits. `in_bytes`: whether the processor multiplies bytes."""
    return _Compiler(head, in_bytes and not (ADDS_PAIRS and head.may_saturate)).program()


class _Compiler:
    def __init__(self, head: HeadArrays, in_bytes: bool) -> None:
        self._head = head
        self._in_bytes = in_bytes
        self._activation = {"gelu": GELU, "hard_swish": HARD_SWISH}[head.form.activation]
        self._weights = _Constants(np.float32)
        self._packed = _Constants(np.int8)
        self._starts = _Constants(np.int32)
        self._n_floats = self._n_bytes = 0
        self._steps: list[Step] = []

    def program(self) -> Program:
        head = self._head
        features, dirs = self._floats(head.n_channels), self._floats(3)
        h = features
        for layer in head.spatial:
            h = self._dense(h, layer, self._activation)
        rounding, *roundings = head.roundings
        h = self._rounded(h, rounding)
        order, harmonics, copies = next(found for found in _orders(head.harmonics) if self._fits(found[0]))
        weight, bias, scale = head.to_sh
        assert scale is not None
        to_sh = Layer(weight[:, order], bias[order], scale[order])
        encoded = self._dense_rounded(h, to_sh, rounding)
        sh = self._harmonics(dirs, harmonics, copies)
        self._steps.append(
            Step(MULTIPLY, x=sh.place, x_pitch=sh.pitch, out=encoded.place, pitch=encoded.pitch)
        )
        z = self._dense_rounded(h, head.bottleneck, rounding)
        z = self._add_encoded(z, encoded, order)
        for layer, rounding in zip(head.directional, roundings, strict=True):
            z = self._dense_rounded(self._rounded(z, rounding), layer, rounding, self._activation)
        rgb = self._dense(z, head.output)
        pairs = [pair for order in range(1, head.form.sh_degree) for pair in _pairs(order)]
        return Program(
            np.array(self._steps, STEP), self._weights.joined(), self._packed.joined(),
            self._starts.joined(), np.array(pairs, np.int64).reshape(-1, 2), self._n_floats, self._n_bytes,
            features, dirs, rgb,
        )  # fmt: skip

    def _floats(self, width: int) -> Value:
        value = Value(self._n_floats, _padded(width), width)
        self._n_floats += BLOCK * value.pitch
        return value

    def _dense(self, x: Value, layer: Layer, activation: int = LINEAR, start: Value | None = None) -> Value:
        """A layer of `x` in float32; its sums begin with the bias, or with the rows of `start`."""
        width = layer.weight.shape[1]
        out = self._floats(width)
        self._steps.append(Step(
            DENSE, x=x.place, x_pitch=x.pitch, depth=x.width, w=self._weights.add(layer.weight),
            start=start.place if start else self._weights.add(layer.bias[None]),
            start_pitch=start.pitch if start else 0, starts_in_memory=start is not None,
            scale=UNSCALED, out=out.place, pitch=out.pitch, activation=activation,
        ))  # fmt: skip
        return out

    def _dense_rounded(self, x: Value, layer: Layer, rounding: Rounding, activation: int = LINEAR) -> Value:
        """A layer of the codes `x`. The code of 0 has been taken off codes in floats; sums of codes in bytes
        begin without what it adds to them."""
        codes, bias, width = layer.weight, layer.bias, layer.weight.shape[1]
        assert layer.scale is not None
        out, scale = self._floats(width), self._weights.add(layer.scale[None])
        if not x.in_bytes:
            self._steps.append(Step(
                DENSE, x=x.place, x_pitch=x.pitch, depth=x.width, w=self._weights.add(codes),
                start=self._weights.add(bias[None]), scale=scale, out=out.place, pitch=out.pitch,
                activation=activation,
            ))  # fmt: skip
            return out
        starts = bias - rounding.zero * codes.sum(axis=0, dtype=np.int64)
        n_quads, n_vectors = -(-x.width // QUAD), _padded(width) // LANES
        table = np.zeros((n_quads * QUAD, n_vectors * LANES), np.int8)
        table[: x.width, :width] = codes
        table = table.reshape(n_quads, QUAD, n_vectors, LANES).transpose(2, 0, 3, 1)
        self._steps.append(Step(
            DENSE_BYTES, x=x.place, depth=n_quads, w=self._packed.add(table.reshape(1, -1)),
            start=self._starts.add(starts[None]), scale=scale, out=out.place, pitch=out.pitch,
            activation=activation,
        ))  # fmt: skip
        return out

    def _add_encoded(self, z: Value, encoded: Value, order: np.ndarray) -> Value:
        """The first directional layer: the activation of z and what comes of the encoded features, which lie
        in an `order`."""
        head, layer = self._head, self._head.from_sh
        layer = layer._replace(weight=layer.weight[order])
        if head.of_encoded is None:
            return self._dense(encoded, layer, self._activation, start=z)
        added = self._dense_rounded(self._rounded(encoded, head.of_encoded), layer, head.of_encoded)
        self._steps.append(Step(
            ADD, x=added.place, x_pitch=added.pitch, out=z.place, pitch=z.pitch, activation=self._activation
        ))  # fmt: skip
        return z

    def _fits(self, order: np.ndarray) -> bool:
        """Whether the encoded features may be multiplied in an `order`, which makes others neighbours."""
        layer = self._head.from_sh
        pairs_count = self._in_bytes and ADDS_PAIRS and layer.scale is not None
        return not pairs_count or pair_sums(layer.weight[order]).max(initial=0) <= PAIR_LIMIT

    def _harmonics(self, dirs: Value, layer: Layer, copies: int) -> Value:
        """The spherical harmonics of directions, each so often."""
        terms = self._floats(len(layer.weight))
        self._steps.append(
            Step(MONOMIALS, x=dirs.place, x_pitch=dirs.pitch, out=terms.place, pitch=terms.pitch)
        )
        sh = self._dense(terms, layer)
        if copies == 1:
            return sh
        out = self._floats(copies * sh.width)
        self._n_floats += _padded(copies)  # whole vectors are written, beyond the last number too
        self._steps.append(Step(
            REPEAT, x=sh.place, x_pitch=sh.pitch, depth=sh.width, copies=copies, out=out.place,
            pitch=out.pitch,
        ))  # fmt: skip
        return out

    def _rounded(self, x: Value, rounding: Rounding) -> Value:
        """`x` as codes: in bytes, or in floats from which the code of 0 is taken off."""
        if self._in_bytes and x.width <= MOST_BYTES:
            out = Value(self._n_bytes, MOST_BYTES, x.width, in_bytes=True)
            self._n_bytes += BLOCK * MOST_BYTES
        else:
            out = self._floats(x.width)
        self._steps.append(Step(
            QUANTIZE if out.in_bytes else ROUND, x=x.place, x_pitch=x.pitch, zero=rounding.zero,
            scale=self._weights.add(np.array([[1 / rounding.scale]], np.float32)), out=out.place,
            pitch=out.pitch,
        ))  # fmt: skip
        return out


def _orders(harmonics: Layer) -> Iterator[tuple[np.ndarray, Layer, int]]:
    """Orders of the encoded features, the fastest first, each with the harmonics that they are multiplied by
    and how often each of these is to be repeated for that.

    Each harmonic is found once if all have as many features. Where they fill whole vectors, those of the
    features can be all of them again and again. Else the features of a harmonic are beside one another. Last,
    each feature has its own, in the order of the file.
    """
    columns = np.vstack([harmonics.bias, harmonics.weight])
    distinct, which = np.unique(columns, axis=1, return_inverse=True)
    n, n_all = distinct.shape[1], columns.shape[1]
    if (np.bincount(which.reshape(-1)) == n_all // n).all():
        by_harmonic = np.argsort(which.reshape(-1), kind="stable")
        first = by_harmonic.reshape(n, -1)[:, 0]
        once = Layer(harmonics.weight[:, first], harmonics.bias[first])
        if n % LANES == 0:
            yield by_harmonic.reshape(n, -1).T.reshape(-1), once, 1
        yield by_harmonic, once, n_all // n
    yield np.arange(n_all), harmonics, 1


def _pairs(order: int) -> list[tuple[int, int]]:
    """The monomial, by its place among all from order 1 on, and the axis that each of an order multiplies."""
    _, parents, axes = monomials(order)
    below = sum(k * (k + 1) // 2 for k in range(2, order))  # monomials of the orders before the one below
    return [(below + parent if order > 1 else -1, axis) for parent, axis in zip(parents, axes, strict=True)]


class _Constants:
    """Tables of one type after one another, their rows padded with zeros to whole vectors."""

    def __init__(self, kind: Any) -> None:
        self._kind = kind
        self._parts: list[np.ndarray] = []
        self._size = 0

    def add(self, rows: np.ndarray) -> int:
        """Append the rows [n_rows, width]; returns the place of the first number."""
        padded = np.zeros((len(rows), _padded(rows.shape[1])), self._kind)
        padded[:, : rows.shape[1]] = rows
        self._parts.append(padded.reshape(-1))
        self._size += padded.size
        return self._size - padded.size

    def joined(self) -> np.ndarray:
        return np.concatenate(self._parts) if self._parts else np.zeros(0, self._kind)


def _padded(width: int) -> int:
    return -(-width // LANES) * LANES
