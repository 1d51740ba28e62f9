"""Reader of ONNX files as graphs of nodes and constants, without the packages onnx and protobuf.

Only what heads of this project hold is read. Anything else is refused: a field that no head has, a field that
occurs twice where the format allows it once, a constant whose number of bytes does not match its shape. So a
file can be understood in only one way, and onnxruntime, which is given the same bytes, understands it in the
same way. Field numbers are those of onnx.proto.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from player.errors import FormatError

FLOAT, UINT8, INT8, INT32 = 1, 2, 3, 6
"""TensorProto's numbers for the data types that are read."""
MAX_FIELDS = 10_000
"""The most fields of all messages in a file: a head of the most layers has a quarter of them."""
_TYPES = {FLOAT: "<f4", UINT8: "u1", INT8: "i1", INT32: "<i4"}


class _Field(NamedTuple):
    """One field of a protobuf message. `kind` is int, bytes, str or, for a nested message, a dict of its
    fields by number."""

    name: str
    kind: Any
    repeated: bool = False


_DIMENSION = {1: _Field("dim_value", int), 2: _Field("dim_param", str)}
_TENSOR_TYPE = {
    1: _Field("elem_type", int),
    2: _Field("shape", {1: _Field("dim", _DIMENSION, repeated=True)}),
}
_PORT = {1: _Field("name", str), 2: _Field("type", {1: _Field("tensor_type", _TENSOR_TYPE)})}
_ATTRIBUTE = {1: _Field("name", str), 3: _Field("i", int), 4: _Field("s", str), 20: _Field("type", int)}
_NODE = {
    1: _Field("input", str, repeated=True),
    2: _Field("output", str, repeated=True),
    3: _Field("name", str),
    4: _Field("op_type", str),
    5: _Field("attribute", _ATTRIBUTE, repeated=True),
}
_TENSOR = {
    1: _Field("dims", int, repeated=True),
    2: _Field("data_type", int),
    8: _Field("name", str),
    9: _Field("raw_data", bytes),
}
_GRAPH = {
    1: _Field("node", _NODE, repeated=True),
    2: _Field("name", str),
    5: _Field("initializer", _TENSOR, repeated=True),
    11: _Field("input", _PORT, repeated=True),
    12: _Field("output", _PORT, repeated=True),
}
_OPERATORS = {1: _Field("domain", str), 2: _Field("version", int)}
_MODEL = {
    1: _Field("ir_version", int),
    2: _Field("producer_name", str),
    7: _Field("graph", _GRAPH),
    8: _Field("opset_import", _OPERATORS, repeated=True),
}


class Node(NamedTuple):
    """One operation of a graph."""

    operator: str
    inputs: tuple[str, ...]
    output: str
    attributes: dict[str, Any]
    """Integers and strings by name."""


class Port(NamedTuple):
    """An input or an output of a graph: [n, width] float32, for any n."""

    name: str
    width: int


@dataclass(frozen=True, eq=False)
class Graph:
    """A graph: nodes in the file's order, constants by name, inputs and outputs."""

    nodes: list[Node]
    constants: dict[str, np.ndarray]
    inputs: list[Port]
    outputs: list[Port]
    opset: int
    ir_version: int


def read_graph(data: bytes, where: str) -> Graph:
    """Read the graph of an ONNX file.

    Args:
        data: the file's bytes.
        where: the name of the file for error messages.

    Raises:
        FormatError: the bytes are no ONNX file, or hold something that no head of this project does.
    """
    left = iter(range(MAX_FIELDS))
    model = _message(data, _MODEL, where, left)
    graph = model.get("graph", _message(b"", _GRAPH, where, left))
    operators = model["opset_import"]
    if len(operators) != 1 or operators[0].get("domain", "") != "" or "version" not in operators[0]:
        raise FormatError(f"{where}: expected an ONNX graph, got one without one version of ONNX's operators")
    constants: dict[str, np.ndarray] = {}
    for tensor in graph["initializer"]:
        name = tensor.get("name", "")
        if name in constants:
            raise FormatError(f"{where}: {_quoted(name)}: expected one constant of this name, got another")
        constants[name] = _constant(tensor, f"{where}: {_quoted(name)}")
    return Graph(
        [_node(node, where) for node in graph["node"]],
        constants,
        [_port(port, where) for port in graph["input"]],
        [_port(port, where) for port in graph["output"]],
        operators[0]["version"],
        model.get("ir_version", 0),
    )


def _node(message: dict[str, Any], where: str) -> Node:
    attributes: dict[str, int | str] = {}
    for attribute in message["attribute"]:
        values = [(key, attribute[key]) for key in ("i", "s") if key in attribute]
        types = {"i": 2, "s": 3}  # AttributeProto.INT and .STRING
        name = attribute.get("name", "")
        if len(values) != 1 or attribute.get("type") != types[values[0][0]] or name in attributes:
            raise FormatError(f"{where}: {_quoted(name)}: expected one integer or text, got something else")
        attributes[name] = values[0][1]
    outputs = message["output"]
    if len(outputs) != 1:
        raise FormatError(f"{where}: expected nodes of one output, got one of {len(outputs)}")
    return Node(message.get("op_type", ""), tuple(message["input"]), outputs[0], attributes)


def _constant(message: dict[str, Any], where: str) -> np.ndarray:
    dims, kind, raw = message["dims"], message.get("data_type"), message.get("raw_data")
    if kind not in _TYPES or raw is None:
        raise FormatError(f"{where}: expected raw numbers of float32, int8, uint8 or int32, got others")
    dtype = np.dtype(_TYPES[kind])
    if not all(dims) or math.prod(dims) * dtype.itemsize != len(raw):  # Python's integers do not overflow
        shape = str(dims) if len(str(dims)) < 80 else f"a shape of {len(dims)} axes"
        raise FormatError(f"{where}: expected the bytes of {dtype.name} {shape}, got {len(raw)} bytes")
    return np.frombuffer(raw, dtype).reshape(dims)


def _port(message: dict[str, Any], where: str) -> Port:
    name = message.get("name", "")
    tensor = message.get("type", {}).get("tensor_type", {})
    dims = tensor.get("shape", {}).get("dim", [])
    free = len(dims) == 2 and "dim_value" not in dims[0] and list(dims[1]) == ["dim_value"]
    if not free or tensor.get("elem_type") != FLOAT:
        raise FormatError(f"{where}: {_quoted(name)}: expected float [n, width], got something else")
    return Port(name, dims[1]["dim_value"])


def _message(data: bytes, fields: dict[int, _Field], where: str, left: Iterator[int]) -> dict[str, Any]:
    """Decode the fields of a protobuf message by name: repeated fields as lists, the others if they are
    present. Each field takes an item of `left`."""
    values: dict[str, Any] = {field.name: [] for field in fields.values() if field.repeated}
    at = 0
    while at < len(data):
        if next(left, None) is None:
            raise FormatError(f"{where}: expected at most {MAX_FIELDS} fields in a head, got more")
        key, at = _varint(data, at, where)
        field = fields.get(key >> 3)
        if field is None:
            raise FormatError(f"{where}: expected an ONNX graph as vfr-bake writes it, got field {key >> 3}")
        if key & 7 != (0 if field.kind is int else 2):
            raise FormatError(f"{where}: expected an ONNX graph, got {field.name} of wire type {key & 7}")
        value, at = _varint(data, at, where)
        if field.kind is not int:
            piece, at = data[at : at + value], at + value
            if at > len(data):
                raise FormatError(f"{where}: expected an ONNX graph, got one cut short")
            value = _content(piece, field.kind, where, left)
        if field.repeated:
            values[field.name].append(value)
        elif field.name in values:
            raise FormatError(f"{where}: expected {field.name} once, got it again")
        else:
            values[field.name] = value
    return values


def _content(piece: bytes, kind: Any, where: str, left: Iterator[int]) -> Any:
    if kind is bytes:
        return piece
    if kind is not str:
        return _message(piece, kind, where, left)
    try:
        return piece.decode()
    except UnicodeDecodeError as error:
        raise FormatError(f"{where}: expected names in UTF-8, got {piece[:20]!r}") from error


def _varint(data: bytes, at: int, where: str) -> tuple[int, int]:
    """Read an integer of at most 64 bits, seven in a byte; returns it and the index behind it. Its encoding
    must be the shortest: protobuf reads at most five bytes for a length, whatever they say."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            raise FormatError(f"{where}: expected an ONNX graph, got one cut short")
        byte = data[at]
        value |= (byte & 127) << shift
        at += 1
        if byte < 128:
            if shift and not byte:
                raise FormatError(f"{where}: expected an ONNX graph, got an integer longer than it has to be")
            break
    else:
        value = 1 << 64
    if value >= 1 << 64:
        raise FormatError(f"{where}: expected an ONNX graph, got an integer of more than 64 bits")
    return value, at


def _quoted(name: str) -> str:
    return ascii(name[:80])
