"""The head, compiled by numba: the same graph that onnxruntime runs, in blocks whose numbers stay in cache.

A float32 head as `exporters.onnx_head` writes it is a dozen small matrix products with a GELU behind each.
onnxruntime makes a pass over memory of every operation, and a third of its time goes into GELU alone; here a
product and what follows it are one pass (`player.dense_tiles`). The graph is read from the ONNX file into a
program of three instructions; a graph with anything else in it, a head with 8-bit layers for one, is left to
onnxruntime.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from player.compiling import compiled
from player.dense_tiles import (
    GELU,
    LANES,
    LINEAR,
    ROWS,
    SIGMOID,
    WIDTH,
    dense_tile,
    multiply_lanes,
)
from player.onnx_graph import Graph, Node

BLOCK = 4 * ROWS
"""Pixels at a time: all the numbers of a 64 wide head are then 300 kB."""
DENSE, MULTIPLY, COPY = range(3)
_ACTIVATIONS = {"Gelu": GELU, "Sigmoid": SIGMOID}


class HeadProgram:
    """A head in three instructions; may be called from several threads at a time."""

    def __init__(self, steps: np.ndarray, weights: np.ndarray, size: int, places: dict[str, Any]) -> None:
        self._steps = steps
        self._weights = weights
        self._size = size
        self._places = (
            tuple(places[name][0] for name in ("features", "dirs", "rgb")),
            tuple(places[name][1] for name in ("features", "dirs", "rgb")),
        )

    def __call__(self, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """As `player.head.Head`."""
        rgb = np.empty((len(features), 3), np.float32)
        inputs = (np.ascontiguousarray(a, np.float32) for a in (features, dirs))
        _run(self._steps, self._weights, np.zeros(self._size, np.float32), *inputs, rgb, self._places)
        return rgb


def compile_head(graph: Graph, n_channels: int) -> HeadProgram | None:
    """The program of a graph; None if there is anything in it but float32 layers."""
    try:
        return _Compiler(graph, n_channels).program()
    except _NotOursError:
        return None


class _NotOursError(Exception):
    """A graph, or a node, that is left to onnxruntime."""


class _Compiler:
    def __init__(self, graph: Graph, n_channels: int) -> None:
        self._graph = graph
        self._constants: list[np.ndarray] = []
        self._n_constants = 0
        self._size = 0
        self._values: dict[str, tuple[int, int, int]] = {}  # place, numbers from row to row, width
        self._steps: list[tuple[int, ...]] = []
        self._add_value("features", n_channels)
        self._add_value("dirs", 3)

    def program(self) -> HeadProgram:
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
            else:
                raise _NotOursError
        if self._value("rgb")[2] != 3:
            raise _NotOursError
        steps, weights = np.array(self._steps, np.int64), np.concatenate(self._constants)
        if not np.isfinite(weights).all():
            raise _NotOursError
        return HeadProgram(steps, weights, self._size, self._values)

    def _value(self, name: str) -> tuple[int, int, int]:
        if name not in self._values:
            raise _NotOursError
        return self._values[name]

    def _add_value(self, name: str, width: int) -> tuple[int, int]:
        pitch = -(-width // WIDTH) * WIDTH
        self._values[name] = self._size, pitch, width
        self._size += BLOCK * pitch
        return self._values[name][:2]

    def _constant(self, array: np.ndarray) -> tuple[int, int]:
        """Rows padded with zeros to whole tiles; its place, and the numbers from row to row."""
        pitch = -(-array.shape[1] // WIDTH) * WIDTH
        padded = np.zeros((len(array), pitch), np.float32)
        padded[:, : array.shape[1]] = array
        self._constants.append(padded.reshape(-1))
        self._n_constants += padded.size
        return self._n_constants - padded.size, pitch

    def _dense(self, node: Node, activation: Node | None) -> None:
        weight = self._graph.constants.get(node.inputs[1])
        x, x_pitch, depth = self._value(node.inputs[0])
        if weight is None or weight.ndim != 2 or len(weight) != depth or node.attributes:
            raise _NotOursError
        if activation is not None and activation.attributes not in ({}, {"approximate": b"none"}):
            raise _NotOursError
        w, w_pitch = self._constant(weight)
        width = weight.shape[1]
        if len(node.inputs) < 3:
            start, start_pitch, in_memory = self._constant(np.zeros((1, width)))[0], 0, 0
        elif node.inputs[2] in self._graph.constants:
            bias = self._graph.constants[node.inputs[2]]
            if bias.shape != (width,):
                raise _NotOursError
            start, start_pitch, in_memory = self._constant(bias[None])[0], 0, 0
        else:
            start, start_pitch, start_width = self._value(node.inputs[2])
            in_memory = 1
            if start_width != width:
                raise _NotOursError
        kind = LINEAR if activation is None else _ACTIVATIONS[activation.operator]
        out, pitch = self._add_value((activation or node).outputs[0], width)
        self._steps.append(
            (DENSE, x, x_pitch, w, w_pitch, start, start_pitch, in_memory, out, pitch, depth, kind)
        )

    def _multiply(self, node: Node) -> None:
        (a, pitch, width), (b, _, other) = (self._value(name) for name in node.inputs)
        if width != other:
            raise _NotOursError
        out, _ = self._add_value(node.outputs[0], width)
        self._steps.append((MULTIPLY, a, pitch, b, 0, 0, 0, 0, out, pitch, 0, 0))

    def _concatenate(self, node: Node) -> None:
        parts = [self._value(name) for name in node.inputs]
        out, pitch = self._add_value(node.outputs[0], sum(width for _, _, width in parts))
        for place, part_pitch, width in parts:
            self._steps.append((COPY, place, part_pitch, 0, 0, 0, 0, 0, out, pitch, width, 0))
            out += width


@compiled
def _run(steps, weights, memory, features, dirs, rgb, places):
    at, pitch = places
    for begin in range(0, len(features), BLOCK):
        n = min(BLOCK, len(features) - begin)
        _fill(memory, at[0], pitch[0], features, begin, n)
        _fill(memory, at[1], pitch[1], dirs, begin, n)
        for i in range(len(steps)):
            step = steps[i]
            if step[0] == DENSE:
                _dense(memory, weights, step, n)
            elif step[0] == MULTIPLY:
                _multiply(memory, step[8], step[1], step[3], n * step[2])
            else:
                for row in range(n):
                    _move(memory, step[8] + row * step[9], step[1] + row * step[2], step[10])
        for row in range(n):
            for c in range(3):
                rgb[begin + row, c] = memory[at[2] + row * pitch[2] + c]


@compiled
def _multiply(memory, out, a, b, n):
    for i in range(0, n, LANES):
        multiply_lanes(memory, out + i, a + i, b + i)


@compiled
def _move(memory, out, a, n):
    for i in range(n):
        memory[out + i] = memory[a + i]


@compiled
def _fill(memory, at, pitch, rows, begin, n):
    for row in range(n):
        for c in range(rows.shape[1]):
            memory[at + row * pitch + c] = rows[begin + row, c]


@compiled
def _dense(memory, weights, step, n):
    """One layer of n pixels, tile by tile; what a tile has beyond n is written and never read."""
    x, x_pitch, w, w_pitch, start, start_pitch = step[1], step[2], step[3], step[4], step[5], step[6]
    out, pitch = step[8], step[9]
    for first in range(0, w_pitch, WIDTH):
        for row in range(0, n, ROWS):
            dense_tile(
                memory, weights, (x + row * x_pitch, x_pitch), (w + first, w_pitch),
                (start + first + row * start_pitch, start_pitch, step[7]),
                (out + first + row * pitch, pitch), step[10], step[11],
            )  # fmt: skip
