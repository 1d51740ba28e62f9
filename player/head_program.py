"""From the graph of a head to a program: the instructions that `player.head_compiled` runs.

A value of the graph is a table in memory of BLOCK pixels by its width, padded to whole tiles. What the graph
rounds to 8 bits is kept in 8 bits where the processor multiplies those (`player.dense_tiles`); elsewhere the
rounded numbers are kept as floats: the same colours, more slowly. A graph with anything else in it is left to
onnxruntime.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from player.activations import GELU, LINEAR, SIGMOID
from player.dense_tiles import MOST_BYTES, MULTIPLIES_BYTES, QUAD, ROWS, WIDTH
from player.onnx_graph import Graph, Node

BLOCK = 4 * ROWS
"""Pixels at a time: all the numbers of a 64 wide head are then 300 kB."""
DENSE, DENSE_BYTES, MULTIPLY, COPY, QUANTIZE, ROUND = range(6)
_ACTIVATIONS = {"Gelu": GELU, "Sigmoid": SIGMOID}
_LARGEST = 2**31 - 1
_MOST_FLOATS = 1 << 22
"""Of all values of a graph, 16 MB: a head 256 wide has a 25th of it."""


class NotOursError(Exception):
    """A graph, or a node, that is left to onnxruntime."""


@dataclass(frozen=True)
class Value:
    """Where a value of the graph is."""

    place: int
    pitch: int
    """Numbers from a pixel to the next."""
    width: int
    scale: np.float32 | None = None
    """Of a value that was rounded to 8 bits: what a step counts."""
    zero: int = 0
    """And the code of 0."""
    in_bytes: bool = False


@dataclass(frozen=True)
class Program:
    """Instructions, what they read, and where the graph's inputs and its output are in memory."""

    steps: np.ndarray
    """[n, 12] int64; what the numbers mean, `player.head_compiled` knows."""
    weights: np.ndarray
    packed: np.ndarray
    """int8 weights as `dense_bytes_tile` takes them."""
    starts: np.ndarray
    """int32 that its sums begin with."""
    n_floats: int
    n_bytes: int
    features: Value
    dirs: Value
    rgb: Value


def program_of(graph: Graph, n_channels: int, in_bytes: bool = MULTIPLIES_BYTES) -> Program:
    """Raises NotOursError for a graph that holds anything but a head's layers in float32 or 8 bits, or that
    breaks the rules of ONNX: onnxruntime says which.

    `in_bytes`: whether the processor multiplies bytes.
    """
    try:
        return _Compiler(graph, n_channels, in_bytes).program()
    except (IndexError, ValueError, TypeError, OverflowError) as error:
        raise NotOursError from error


class _Compiler:
    def __init__(self, graph: Graph, n_channels: int, in_bytes: bool) -> None:
        self._graph = graph
        self._in_bytes = in_bytes
        self._weights = _Constants(np.float32)
        self._packed = _Constants(np.int8)
        self._starts = _Constants(np.int32)
        self._n_floats = self._n_bytes = 0
        self._values: dict[str, Value] = {}
        self._codes: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # constants: codes, steps of the last axis
        self._steps: list[tuple[int, ...]] = []
        self._add("features", n_channels)
        self._add("dirs", 3)

    def program(self) -> Program:
        nodes = list(self._graph.nodes)
        while nodes:
            node = nodes.pop(0)
            followed = (
                nodes and nodes[0].operator in _ACTIVATIONS and nodes[0].inputs == node.outputs
                and not any(node.outputs[0] in other.inputs for other in nodes[1:])
            )  # fmt: skip
            if node.operator in ("Gemm", "MatMul"):
                self._dense(node, nodes.pop(0) if followed else None)
            elif node.operator == "Mul":
                self._multiply(node)
            elif node.operator == "Concat" and node.attributes == {"axis": 1}:
                self._concatenate(node)
            elif node.operator == "QuantizeLinear":
                self._quantize(node)
            elif node.operator == "DequantizeLinear":
                self._dequantize(node)
            else:
                raise NotOursError
        rgb = self._floats("rgb")
        if rgb.width != 3:
            raise NotOursError
        weights = self._weights.joined()
        if not np.isfinite(weights).all():
            raise NotOursError
        return Program(
            np.array(self._steps, np.int64), weights, self._packed.joined(), self._starts.joined(),
            self._n_floats, self._n_bytes, self._values["features"], self._values["dirs"], rgb,
        )  # fmt: skip

    def _value(self, name: str) -> Value:
        if name not in self._values:
            raise NotOursError
        return self._values[name]

    def _floats(self, name: str) -> Value:
        value = self._value(name)
        if value.in_bytes:
            raise NotOursError
        return value

    def _constant(self, name: str) -> np.ndarray:
        if name not in self._graph.constants:
            raise NotOursError
        return self._graph.constants[name]

    def _add(self, name: str, width: int) -> Value:
        pitch = _padded(width)
        self._values[name] = Value(self._n_floats, pitch, width)
        self._n_floats += BLOCK * pitch
        if self._n_floats > _MOST_FLOATS:
            raise NotOursError
        return self._values[name]

    def _step(self, *numbers: int) -> None:
        self._steps.append((*numbers, *[0] * (12 - len(numbers))))

    def _dense(self, node: Node, activation: Node | None) -> None:
        if node.attributes or (activation is not None and activation.attributes not in _EXACT):
            raise NotOursError
        kind = LINEAR if activation is None else _ACTIVATIONS[activation.operator]
        out = (activation or node).outputs[0]
        if self._value(node.inputs[0]).in_bytes:
            self._dense_bytes(node, out, kind)
            return
        x, weight = self._value(node.inputs[0]), self._floats_of(node.inputs[1])
        if weight.ndim != 2 or len(weight) != x.width:
            raise NotOursError
        width = weight.shape[1]
        if len(node.inputs) < 3:
            start, start_pitch, in_memory = self._weights.add(np.zeros((1, width))), 0, 0
        elif node.inputs[2] in self._values:
            before = self._floats(node.inputs[2])
            start, start_pitch, in_memory = before.place, before.pitch, 1
            if before.width != width:
                raise NotOursError
        else:
            bias = self._floats_of(node.inputs[2])
            if bias.shape != (width,):
                raise NotOursError
            start, start_pitch, in_memory = self._weights.add(bias[None]), 0, 0
        w = self._weights.add(weight)
        to = self._add(out, width)
        self._step(
            DENSE, x.place, x.pitch, w, _padded(width), start, start_pitch, in_memory, to.place, to.pitch,
            x.width, kind,
        )  # fmt: skip

    def _floats_of(self, name: str) -> np.ndarray:
        """A constant, or what the codes of one stand for."""
        if name in self._codes:
            codes, steps = self._codes[name]
            return codes.astype(np.float32) * steps
        constant = self._constant(name)
        if constant.dtype != np.float32:
            raise NotOursError
        return constant

    def _dense_bytes(self, node: Node, out: str, kind: int) -> None:
        x = self._value(node.inputs[0])
        if len(node.inputs) != 3 or not set(node.inputs[1:]) <= set(self._codes):
            raise NotOursError
        (codes, steps), (bias, bias_steps) = (self._codes[name] for name in node.inputs[1:])
        if codes.dtype != np.int8 or codes.ndim != 2 or len(codes) != x.width:
            raise NotOursError
        width = codes.shape[1]
        if bias.shape != (width,) or not np.array_equal(bias_steps, steps * x.scale):
            raise NotOursError
        starts = bias.astype(np.int64) - x.zero * codes.sum(axis=0, dtype=np.int64)
        if (np.abs(starts) + 255 * np.abs(codes.astype(np.int64)).sum(axis=0) > _LARGEST).any():
            raise NotOursError
        n_quads, tiles = -(-x.width // QUAD), _padded(width) // WIDTH
        table = np.zeros((n_quads * QUAD, tiles * WIDTH), np.int8)
        table[: x.width, :width] = codes
        table = table.reshape(n_quads, QUAD, tiles, WIDTH).transpose(2, 0, 3, 1)
        to = self._add(out, width)
        self._step(
            DENSE_BYTES, x.place, 0, self._packed.add(table.reshape(1, -1)),
            self._starts.add(starts[None]), self._weights.add(bias_steps[None]), 0, 0, to.place, to.pitch,
            n_quads, kind,
        )  # fmt: skip

    def _multiply(self, node: Node) -> None:
        a, b = (self._floats(name) for name in node.inputs)
        if a.width != b.width:
            raise NotOursError
        out = self._add(node.outputs[0], a.width)
        self._step(MULTIPLY, a.place, a.pitch, b.place, 0, 0, 0, 0, out.place)

    def _concatenate(self, node: Node) -> None:
        parts = [self._floats(name) for name in node.inputs]
        out = self._add(node.outputs[0], sum(part.width for part in parts))
        at = out.place
        for part in parts:
            self._step(COPY, part.place, part.pitch, 0, 0, 0, 0, 0, at, out.pitch, part.width)
            at += part.width

    def _quantize(self, node: Node) -> None:
        """To codes in bytes, or to the numbers that they stand for."""
        x, (scale, zero) = self._floats(node.inputs[0]), (self._constant(name) for name in node.inputs[1:])
        if node.attributes or scale.size != 1 or zero.size != 1 or zero.dtype != np.uint8 or not scale > 0:
            raise NotOursError
        scale, zero = scale.item(), zero.item()
        numbers = self._weights.add(np.array([[1 / scale, scale]], np.float32))
        if self._in_bytes and x.width <= MOST_BYTES:
            kind, out = QUANTIZE, Value(self._n_bytes, MOST_BYTES, x.width, in_bytes=True)
            self._n_bytes += BLOCK * MOST_BYTES
        else:
            kind, out = ROUND, self._add(node.outputs[0], x.width)
        self._values[node.outputs[0]] = replace(out, scale=np.float32(scale), zero=zero)
        self._step(kind, x.place, x.pitch, numbers, zero, 0, 0, 0, out.place)

    def _dequantize(self, node: Node) -> None:
        """Codes are kept; only what they count is noted."""
        name, scale, zero = node.inputs[0], *(self._constant(name) for name in node.inputs[1:])
        if name in self._values:
            value = self._values[name]
            if node.attributes or value.scale is None or scale != value.scale or zero != value.zero:
                raise NotOursError
            self._values[node.outputs[0]] = value
            return
        codes = self._constant(name)
        last = codes.ndim - 1
        if node.attributes != {"axis": last} or zero.any() or scale.shape != codes.shape[last:]:
            raise NotOursError
        self._codes[node.outputs[0]] = codes, scale


_EXACT = ({}, {"approximate": b"none"})


class _Constants:
    """Numbers of one kind after one another, rows padded with zeros to whole tiles."""

    def __init__(self, kind: type) -> None:
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
