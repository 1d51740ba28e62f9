"""Compiler from the numbers of a head in 8 bits to a program: the instructions that `player.head.compiled`
runs.

Every value of the head is a table in memory: BLOCK pixels by its width, padded to whole vectors. All indices
and sizes follow from the widths that `player.head.graph` has checked. Values that are rounded to 8 bits are
kept in bytes where the processor multiplies bytes (`player.head.dense_tiles`). Elsewhere their codes are kept
as floats: sums of products are then the same integers, added up more slowly. Codes are also kept as floats
where the processor adds up two products in 16 bits, and the weights are so large that these do not fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from player.head.activations import GELU, HARD_SWISH, LINEAR
from player.head.dense_tiles import ADDS_PAIRS, LANES, MOST_BYTES, MULTIPLIES_BYTES, QUAD, ROWS, UNSCALED
from player.head.graph import PAIR_LIMIT, HeadArrays, Layer, Rounding, monomial_products, pair_sums

BLOCK = 4 * ROWS
"""Pixels that are processed at a time: all the numbers of a head of width 64 then take 150 kB."""
DENSE, DENSE_BYTES, MULTIPLY, ADD, REPEAT, MONOMIALS, QUANTIZE, ROUND = range(8)
"""The kinds of steps."""


class Value(NamedTuple):
    """A table of BLOCK pixels in memory."""

    place: int
    """Index of the table's first number."""
    pitch: int
    """Numbers from a pixel to the next."""
    width: int
    """Numbers of a pixel that are used; the others, up to `pitch`, are padding."""
    in_bytes: bool = False
    """Whether the table is in the memory of bytes, not in that of floats."""


class Step(NamedTuple):
    """One instruction, which reads the table at `x` and writes the table at `out`. Places are indices of
    first numbers."""

    kind: int
    x: int = 0
    x_pitch: int = 0
    depth: int = 0
    """DENSE: number of inputs of the layer. DENSE_BYTES: number of QUADs of inputs. REPEAT: numbers of a
    pixel."""
    w: int = 0
    """Place of the layer's weights."""
    copies: int = 1
    """REPEAT: number of times that each number is written."""
    start: int = 0
    """Place of the numbers that the layer's sums begin with."""
    start_pitch: int = 0
    """Distance, in numbers, between what the sums of neighbouring pixels begin with; 0 if all begin with the
    same numbers."""
    starts_in_memory: int = 0
    """1 if the sums begin with a table in memory, 0 if they begin with a bias among the weights."""
    scale: int = 0
    """Place of the factors of the layer's sums, or UNSCALED. QUANTIZE, ROUND: place of the number of levels
    per unit."""
    zero: int = 0
    """QUANTIZE, ROUND: the code of 0."""
    out: int = 0
    """Place of the result. MULTIPLY, ADD: the table there is multiplied by `x`, or `x` is added to it.
    MULTIPLY: rows of `x` may be shorter than those of the table; they are then repeated."""
    pitch: int = 0
    activation: int = LINEAR


STEP = np.dtype([(name, np.int64) for name in Step._fields])
"""The dtype of a `Step` for compiled code."""


@dataclass(frozen=True)
class Program:
    """Instructions, the constants that they read, and the places of the head's inputs and output in
    memory."""

    steps: np.ndarray
    """[n_steps] STEP."""
    weights: np.ndarray
    """[n] float32 weights, biases and scales."""
    packed: np.ndarray
    """[n] int8 weights, in the order in which `dense_bytes_tile` takes them."""
    starts: np.ndarray
    """[n] int32, the numbers that the sums of `dense_bytes_tile` begin with."""
    pairs: np.ndarray
    """[n_monomials, 2] int64: the two factors of each monomial, an earlier monomial (-1 for 1) and an axis, 0
    to 2."""
    n_floats: int
    """Numbers that all tables in floats take."""
    n_bytes: int
    """Bytes that all tables in bytes take."""
    features: Value
    dirs: Value
    rgb: Value
    """The table whose sigmoid is the colour."""


def program_of(head: HeadArrays, in_bytes: bool = MULTIPLIES_BYTES) -> Program:
    """Compile the program of a head in 8 bits. `in_bytes`: whether the processor multiplies bytes."""
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
        pairs = monomial_products(head.form.sh_degree)
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
        """Add a layer of `x` in float32. Its sums begin with the bias, or with the rows of `start`."""
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
        """Add a layer of the codes `x`. Codes in floats are stored minus the code of 0. With codes in bytes,
        the sums begin with the bias minus what the code of 0 adds to them."""
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
        """Add the first directional layer, up to its activation: `z` holds what comes of h; what comes of the
        encoded features, which are in an `order`, is added."""
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
        """Return whether the encoded features may be multiplied in an `order`: it makes other weights
        neighbours, whose sums of magnitudes must not exceed PAIR_LIMIT where the processor adds up pairs."""
        layer = self._head.from_sh
        pairs_count = self._in_bytes and ADDS_PAIRS and layer.scale is not None
        return not pairs_count or pair_sums(layer.weight[order]).max(initial=0) <= PAIR_LIMIT

    def _harmonics(self, dirs: Value, layer: Layer, copies: int) -> Value:
        """Add the spherical harmonics of directions, each repeated `copies` times."""
        terms = self._floats(len(layer.weight))
        self._steps.append(
            Step(MONOMIALS, x=dirs.place, x_pitch=dirs.pitch, out=terms.place, pitch=terms.pitch)
        )
        sh = self._dense(terms, layer)
        if copies == 1:
            return sh
        out = self._floats(copies * sh.width)
        self._n_floats += _padded(copies)  # the last whole vector may reach beyond the last number
        self._steps.append(Step(
            REPEAT, x=sh.place, x_pitch=sh.pitch, depth=sh.width, copies=copies, out=out.place,
            pitch=out.pitch,
        ))  # fmt: skip
        return out

    def _rounded(self, x: Value, rounding: Rounding) -> Value:
        """Add the rounding of `x` to codes: in bytes, or in floats minus the code of 0."""
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
    """Yield orders of the encoded features, the fastest first. With each come the harmonics that the features
    are multiplied by, and how often each harmonic is to be repeated for that.

    If all harmonics have the same number of features, each harmonic is computed only once. If the harmonics
    then fill whole vectors, the first order puts one feature of every harmonic after another, so that the row
    of harmonics is simply used again and again. The next order puts the features of a harmonic side by side.
    The last is the order of the file, in which each feature has a harmonic of its own.
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


class _Constants:
    """Tables of one type, stored one after the other, with rows padded with zeros to whole vectors."""

    def __init__(self, kind: Any) -> None:
        self._kind = kind
        self._parts: list[np.ndarray] = []
        self._size = 0

    def add(self, rows: np.ndarray) -> int:
        """Append the rows [n_rows, width]; returns the index of the first number."""
        padded = np.zeros((len(rows), _padded(rows.shape[1])), self._kind)
        padded[:, : rows.shape[1]] = rows
        self._parts.append(padded.reshape(-1))
        self._size += padded.size
        return self._size - padded.size

    def joined(self) -> np.ndarray:
        return np.concatenate(self._parts) if self._parts else np.zeros(0, self._kind)


def _padded(width: int) -> int:
    return -(-width // LANES) * LANES
