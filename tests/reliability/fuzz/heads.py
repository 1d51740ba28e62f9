"""Broken heads: in the bytes of the file, in the structure by the package `onnx`, and with fields of protobuf
that no package writes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from exporters.head.onnx_head import head_onnx
from player.compiling import available
from player.head.head import Head
from tests.exporters.head.test_onnx_head import random_head
from tests.reliability.fuzz.broken import broken_bytes
from tests.reliability.fuzz.targets import Target, check_colours

N_CHANNELS = 4
OPERATORS = (
    *(
        "Add",
        "Sub",
        "Mul",
        "Div",
        "MatMul",
        "Gemm",
        "Gelu",
        "Sigmoid",
        "Concat",
        "Slice",
        "Split",
    ),
    *("Reshape", "Transpose", "Unsqueeze", "Squeeze", "Gather", "Expand", "Tile", "Shape", "Cast", "Pow"),
    *("QuantizeLinear", "DequantizeLinear", "ConstantOfShape", "Constant", "Loop", "If", "Scan", "Pad"),
    *("HardSwish", "HardSigmoid"),
    *("RandomNormal", "Einsum", "LSTM", "Optional", "SequenceEmpty", "NonZero", "Resize", "TfIdfVectorizer"),
)
DIMENSIONS = (-(2**63), -1, 0, 1, 2, 3, 4, 7, 8, 9, 16, 255, 2**31, 2**32, 2**40, 2**62, 2**63 - 1)
Change = Callable[[Any, np.random.Generator], None]


def _pick(items: Any, random: np.random.Generator) -> Any:
    return items[int(random.integers(0, len(items)))]


def _names(graph: Any) -> list[str]:
    found = [name for node in graph.node for name in (*node.input, *node.output)]
    ports = [value.name for value in (*graph.input, *graph.output)]
    return [*found, *ports, *(tensor.name for tensor in graph.initializer), "", "n", "features", "rgb", "\0"]


def _rename(model: Any, random: np.random.Generator) -> None:
    """Give an input or output of a node or of the graph another name: one in use, or one that nothing has."""
    graph, node = model.graph, _pick(model.graph.node, random)
    match int(random.integers(0, 5)):
        case 0 | 1 if len(node.output):
            node.output[int(random.integers(0, len(node.output)))] = _pick(_names(graph), random)
        case 2 if len(node.input):
            node.input[int(random.integers(0, len(node.input)))] = _pick(_names(graph), random)
        case 3:
            _pick([*graph.input, *graph.output], random).name = _pick(_names(graph), random)
        case _:
            _pick(graph.initializer, random).name = _pick(_names(graph), random)


def _more(model: Any, random: np.random.Generator) -> None:
    """Repeat or remove a node, a tensor, a port or an opset."""
    graph = model.graph
    items = _pick([graph.node, graph.initializer, graph.input, graph.output, model.opset_import], random)
    if not len(items):
        return
    if random.random() < 0.4:
        del items[int(random.integers(0, len(items)))]
    else:
        items.append(_pick(items, random))


def _reorder(model: Any, random: np.random.Generator) -> None:
    items = _pick([model.graph.node, model.graph.initializer, model.graph.input], random)
    order = [onnx.NodeProto.FromString(item.SerializeToString()) if isinstance(item, onnx.NodeProto) else
             type(item).FromString(item.SerializeToString()) for item in items]  # fmt: skip
    order = [order[i] for i in random.permutation(len(order))]
    del items[:]
    items.extend(order)


def _dims(model: Any, random: np.random.Generator) -> None:
    """Change the dimensions of a tensor; its numbers are changed to fit, or not."""
    tensor = _pick(model.graph.initializer, random)
    dims = list(tensor.dims) or [1]
    match int(random.integers(0, 5)):
        case 0:
            dims[int(random.integers(0, len(dims)))] = int(_pick(DIMENSIONS, random))
        case 1:
            dims = dims[::-1]
        case 2:
            dims = [int(np.prod(dims))]
        case 3:
            dims = [1] * int(random.integers(1, 12)) + dims
        case 4:
            dims = [max(int(value + random.integers(-1, 2)), 0) for value in dims]
    del tensor.dims[:]
    tensor.dims.extend(dims)
    n_numbers = int(np.prod([float(value) for value in dims]))
    if random.random() < 0.7 and 0 <= n_numbers < 1 << 16:
        itemsize = {1: 4, 2: 1, 3: 1, 6: 4, 7: 8}.get(tensor.data_type, 4)
        data = tensor.raw_data or b"\0"
        tensor.raw_data = (data * (n_numbers * itemsize // len(data) + 1))[: n_numbers * itemsize]


def _numbers(model: Any, random: np.random.Generator) -> None:
    """Change the numbers of a tensor: NaN, huge or tiny ones, another type, another field, none."""
    tensor = _pick(model.graph.initializer, random)
    match int(random.integers(0, 6)):
        case 0:
            tensor.data_type = int(random.integers(0, 24))
        case 1:
            tensor.raw_data = broken_bytes(tensor.raw_data, random)
        case 2:
            value = np.float32(_pick([np.nan, np.inf, -np.inf, 3e38, 1e-45, -0.0], random))
            tensor.raw_data = value.tobytes() * (len(tensor.raw_data) // 4)
        case 3:
            tensor.float_data.extend([1.0] * int(random.integers(1, 40)))
        case 4:
            tensor.int32_data.extend([1] * int(random.integers(1, 40)))
            tensor.ClearField("raw_data")
        case 5:
            tensor.string_data.append(b"a")


def _operator(model: Any, random: np.random.Generator) -> None:
    node = _pick(model.graph.node, random)
    if random.random() < 0.3:
        node.domain = _pick(["", "ai.onnx", "com.microsoft", "ai.onnx.ml", "x"], random)
    node.op_type = _pick(OPERATORS, random)


def _attribute(model: Any, random: np.random.Generator) -> None:
    node = _pick(model.graph.node, random)
    if len(node.attribute) and random.random() < 0.6:
        attribute = _pick(node.attribute, random)
        match int(random.integers(0, 4)):
            case 0:
                attribute.i = int(_pick(DIMENSIONS, random))
            case 1:
                attribute.type = int(random.integers(0, 15))
            case 2:
                attribute.ints.extend([int(_pick(DIMENSIONS, random)) for _ in range(3)])
            case 3:
                node.attribute.append(attribute)
        return
    name = _pick(["axis", "to", "alpha", "approximate", "value", "perm", "num_outputs", "body", ""], random)
    values: list[Any] = [1, -7, 2**40, 0.5, "tanh", [1, 0], [0.5], b"\xff"]
    node.attribute.append(onnx.helper.make_attribute(name, _pick(values, random)))


def _graphs(model: Any, random: np.random.Generator) -> None:
    """Add what a head may not have: a graph in a node, functions, sparse tensors, numbers in other files."""
    graph = model.graph
    match int(random.integers(0, 5)):
        case 0:
            attribute = onnx.helper.make_attribute("body", graph)
            _pick(graph.node, random).attribute.append(attribute)
        case 1:
            node = _pick(graph.node, random)
            model.functions.append(
                onnx.helper.make_function(
                    "x", node.op_type, ["a"], ["b"], list(graph.node), model.opset_import
                )
            )
        case 2:
            tensor = _pick(graph.initializer, random)
            place = _pick(["/etc/passwd", "../whole/head.onnx", "manifest.json", "/dev/zero", "x"], random)
            tensor.data_location = onnx.TensorProto.EXTERNAL
            for key, value in (("location", place), ("offset", "0"), ("length", str(len(tensor.raw_data)))):
                tensor.external_data.add(key=key, value=value)
            if random.random() < 0.7:
                tensor.ClearField("raw_data")
        case 3:
            graph.sparse_initializer.add(dims=[4, 3]).values.CopyFrom(_pick(graph.initializer, random))
        case 4:
            graph.quantization_annotation.add(tensor_name="features")


def _ports(model: Any, random: np.random.Generator) -> None:
    port = _pick([*model.graph.input, *model.graph.output, *model.graph.value_info], random)
    shape = port.type.tensor_type.shape
    match int(random.integers(0, 4)):
        case 0 if len(shape.dim):
            _pick(shape.dim, random).dim_value = int(_pick(DIMENSIONS, random))
        case 1:
            shape.dim.add(dim_param=_pick(["n", "m", "", "\u202e"], random))
        case 2:
            port.type.tensor_type.elem_type = int(random.integers(0, 24))
        case _:
            model.graph.value_info.append(port)


def _header(model: Any, random: np.random.Generator) -> None:
    match int(random.integers(0, 3)):
        case 0:
            model.ir_version = int(_pick(DIMENSIONS, random))
        case 1:
            _pick(model.opset_import, random).version = int(
                _pick([0, 1, 7, 13, 17, 19, 21, 23, 99, 2**40], random)
            )
        case 2:
            model.opset_import.add(domain="com.microsoft", version=1)


CHANGES: tuple[Change, ...] = (
    *(_rename, _rename, _more, _reorder, _dims, _dims, _numbers, _operator),
    *(_attribute, _graphs, _ports, _header),
)


# --- fields of protobuf that no package writes ---


def _varint(value: int, spare: int = 0) -> bytes:
    """Return a number in protobuf's form, with `spare` bytes more than needed."""
    out = bytearray()
    while value >= 128 or spare > 0:
        out.append(value & 127 | 128)
        value >>= 7
        spare -= value == 0
    return bytes([*out, value])


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        value |= (data[at] & 127) << shift
        at, shift = at + 1, shift + 7
        if data[at - 1] < 128:
            return value, at


def _fields(data: bytes) -> list[tuple[int, int, bytes]]:
    """Return the number, wire type and value of each field of a whole message."""
    found, at = [], 0
    while at < len(data):
        key, at = _read_varint(data, at)
        start, size = at, {1: 8, 5: 4}.get(key & 7, 0)
        if key & 7 == 0:
            _, at = _read_varint(data, at)
        else:
            if key & 7 == 2:
                size, at = _read_varint(data, at)
                start = at
            at += size
        found.append((key >> 3, key & 7, data[start:at]))
    return found


def _joined(fields: list[tuple[int, int, bytes]], random: np.random.Generator | None = None) -> bytes:
    parts = []
    for number, wire, value in fields:
        spare = int(random.integers(1, 12)) if random is not None and random.random() < 0.2 else 0
        size = _varint(len(value), spare) if wire == 2 else b""
        parts.append(_varint(number << 3 | wire) + size + value)
    return b"".join(parts)


def _unusual(data: bytes, random: np.random.Generator, depth: int = 0) -> bytes:
    """Return nearly the same message: with singular fields twice, unknown fields, long numbers or another
    order, in itself or in a message within it."""
    fields = _fields(data)
    if not fields:
        return data
    index = int(random.integers(0, len(fields)))
    number, wire, value = fields[index]
    if wire == 2 and depth < 4 and random.random() < 0.7 and number in (7, 1, 5, 11, 12, 2):
        try:
            fields[index] = (number, wire, _unusual(value, random, depth + 1))
            return _joined(fields)
        except IndexError:  # text, not a message
            pass
    match int(random.integers(0, 7)):
        case 0:
            fields.insert(int(random.integers(0, len(fields) + 1)), fields[index])
        case 1:
            fields.append((int(random.integers(1, 3000)), 2, random.bytes(int(random.integers(0, 20)))))
        case 2:
            fields = [fields[i] for i in random.permutation(len(fields))]
        case 3:
            return _joined(fields, random)
        case 4:
            fields[index] = (number, int(random.integers(0, 8)), value)
        case 5:
            fields.append((number, wire, broken_bytes(value, random)))
        case 6:
            fields.insert(index, (int(random.integers(1, 100)), 3, b""))
    return _joined(fields)


def broken_head(model: bytes, random: np.random.Generator) -> bytes:
    """Return a broken head, or a valid head in an unusual form."""
    share = random.random()
    if share < 0.15:
        return broken_bytes(model, random)
    if share < 0.4:
        for _ in range(int(random.integers(1, 4))):
            try:
                model = _unusual(model, random)
            except IndexError:  # no message any more
                return model
        return model
    changed = onnx.ModelProto.FromString(model)
    for _ in range(int(random.integers(1, 3))):
        try:
            CHANGES[random.integers(0, len(CHANGES))](changed, random)
        except (ValueError, TypeError, OverflowError, IndexError):  # nothing of that kind is left to change
            pass
    return changed.SerializeToString()


def head_targets(work: Path, small: bytes) -> list[Target]:
    """Return targets for float32 and 8-bit heads, by onnxruntime and compiled; `small` has few operators."""
    path = work / "head.onnx"
    random = np.random.default_rng(0)
    features = np.concatenate([np.zeros((1, N_CHANNELS)), random.normal(0, 50, (4, N_CHANNELS))])
    dirs = random.normal(size=(5, 3))
    dirs /= np.linalg.norm(dirs, axis=-1, keepdims=True)
    weights = random_head(n_channels=N_CHANNELS, width=8, sh_degree=2, n_sh_features=2, n_more=1)
    wholes = {
        "small head": small,
        "head": head_onnx(weights),
        "head in 8 bits": head_onnx(replace(weights, activation="hard_swish"), [(-0.2, 1.0)] * 3),
    }

    def read(compiled: bool) -> None:
        head = Head(path.read_bytes(), N_CHANNELS, compiled)
        check_colours(head(features.astype(np.float32), dirs.astype(np.float32)), len(dirs))

    def prepare(whole: bytes, random: np.random.Generator) -> None:
        path.write_bytes(broken_head(whole, random))

    found = []
    for name, whole in wholes.items():
        for compiled in (False, True) if available() else (False,):
            path.write_bytes(whole)
            read(compiled)  # numba loads compiled code once
            kind = f"{name}, {'compiled' if compiled else 'onnxruntime'}"
            found.append(Target(kind, partial(prepare, whole), partial(read, compiled)))
    return found
