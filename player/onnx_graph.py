"""What is in an ONNX file: nodes and constants of its graph, read without the package onnx.

Field numbers are those of onnx.proto: ModelProto.graph 7; GraphProto.node 1, .initializer 5; NodeProto.input
1, .output 2, .op_type 4, .attribute 5, .domain 7; AttributeProto.name 1, .i 3, .s 4; TensorProto.dims 1,
.data_type 2, .name 8, .raw_data 9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from player.head import _dims, _fields

KINDS = {1: "<f4", 2: "u1", 3: "i1", 6: "<i4"}
"""TensorProto's numbers of the types that are read."""


@dataclass(frozen=True)
class Node:
    """One operation."""

    operator: str
    """With its domain, where that is not ONNX's own."""
    inputs: list[str]
    outputs: list[str]
    attributes: dict[str, int | bytes]
    """Integers and texts; any other kind is the number -1."""


@dataclass(frozen=True)
class Graph:
    """Nodes in the file's order, and constants by name: float32, int32, and bytes."""

    nodes: list[Node]
    constants: dict[str, np.ndarray]


def read_graph(data: bytes) -> Graph:
    """The graph of an ONNX file; constants of other types, or that are not kept as raw bytes, are left out.

    Raises FormatError for bytes that are no protobuf message.
    """
    nodes: list[Node] = []
    constants: dict[str, np.ndarray] = {}
    for number, graph in _fields(data):
        if number != 7 or not isinstance(graph, bytes):
            continue
        for field, item in _fields(graph):
            if field == 1 and isinstance(item, bytes):
                nodes.append(_node(item))
            elif field == 5 and isinstance(item, bytes):
                _read_constant(item, constants)
    return Graph(nodes, constants)


def _node(data: bytes) -> Node:
    names: dict[int, list[str]] = {1: [], 2: [], 4: [], 7: []}
    attributes: dict[str, int | bytes] = {}
    for field, item in _fields(data):
        if field in names and isinstance(item, bytes):
            names[field].append(item.decode(errors="replace"))
        elif field == 5 and isinstance(item, bytes):
            parts = dict(_fields(item))
            name = parts.get(1)
            text = name.decode(errors="replace") if isinstance(name, bytes) else "no name"
            attributes[text] = parts.get(3, parts.get(4, -1))
    domain = "".join(names[7])
    return Node("".join(names[4]) + (f" of {domain}" if domain else ""), names[1], names[2], attributes)


def _read_constant(data: bytes, constants: dict[str, np.ndarray]) -> None:
    parts = dict(_fields(data))
    name, raw = parts.get(8), parts.get(9)
    shape = list(_dims(data))
    kind = KINDS.get(number) if isinstance(number := parts.get(2), int) else None
    if not isinstance(name, bytes) or not isinstance(raw, bytes) or kind is None:
        return
    if len(raw) == np.dtype(kind).itemsize * int(np.prod(shape, dtype=np.int64)):
        constants[name.decode(errors="replace")] = np.frombuffer(raw, kind).reshape(shape)
