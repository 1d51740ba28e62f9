"""The head: from the composited features of a pixel and its direction to its colour, by compiled code or
onnxruntime.

Either is imported when a head is opened that needs it, so that `vfr-play --help` answers at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from player.errors import FormatError

CHUNK = 2048
"""Pixels a run: the activations of a 256 wide layer (2 MB) stay in the second-level cache, 25-45 % faster
than at once."""


class Head:
    """An open head; may be called from several threads at a time.

    Each call runs on its caller's thread: the player works on many tiles at once, so one thread a run
    wastes none.
    """

    def __init__(self, path: Path, n_channels: int, compiled: bool = False) -> None:
        """Open the head; with `compiled`, numba runs the graph where it can (`player.head_compiled`)."""
        data = path.read_bytes()
        _check_content(path, data)
        self._path = path
        if compiled:
            from player.head_compiled import compile_head
            from player.onnx_graph import read_graph

            program = compile_head(read_graph(data), n_channels)
            if program is not None:  # and onnxruntime need not be loaded
                self._run = program
                return
        self._open_session(data, n_channels)
        self._run = self._by_onnxruntime

    def _open_session(self, data: bytes, n_channels: int) -> None:
        import onnxruntime as ort
        from onnxruntime.capi import onnxruntime_pybind11_state as state  # pyright: ignore[reportAttributeAccessIssue]

        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4  # fatal alone: what fails is raised as well
        self._failures = (
            state.Fail,
            state.RuntimeException,
            state.InvalidProtobuf,
            state.InvalidGraph,
            state.InvalidArgument,
            state.NotImplemented,
            UnicodeDecodeError,  # of a message that repeats a name which is no UTF-8
        )
        path = self._path
        try:
            session = ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except (*self._failures, RuntimeError, ValueError) as error:
            raise FormatError(f"{path}: expected an ONNX graph, got: {_first_line(error)}") from error
        try:
            _check_ports(path, "input", session.get_inputs(), {"features": n_channels, "dirs": 3})
            _check_ports(path, "output", session.get_outputs(), {"rgb": 3})
        except UnicodeDecodeError as error:
            raise FormatError(f"{path}: expected names in UTF-8, got: {_first_line(error)}") from error
        self._session = session

    def __call__(self, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """Colours of n pixels.

        Args:
            features: [n, n_channels] float32 composited features.
            dirs: [n, 3] float32 unit directions, model frame.

        Returns:
            rgb: [n, 3] float32, 0..1, in the manifest's colour space.

        Raises:
            FormatError: the graph fails, or what it gives is not one finite colour a pixel.
        """
        rgb = np.empty((len(features), 3), np.float32)
        for start in range(0, len(features), CHUNK):
            part = slice(start, start + CHUNK)
            rgb[part] = self._checked(self._run(features[part], dirs[part]), len(features[part]))
        return rgb

    def _by_onnxruntime(self, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        try:
            out = np.asarray(self._session.run(["rgb"], {"features": features, "dirs": dirs})[0])
        except self._failures as error:
            raise FormatError(
                f"{self._path}: expected a head that runs, got: {_first_line(error)}"
            ) from error
        return out

    def _checked(self, out: np.ndarray, n: int) -> np.ndarray:
        if out.shape != (n, 3) or not np.isfinite(out).all():
            raise FormatError(
                f"{self._path}: rgb: expected {n} finite colours, got "
                f"{'NaN or infinity' if out.shape == (n, 3) else list(out.shape)}"
            )
        return out


class _ProtobufError(FormatError):
    """Bytes that are no protobuf message."""


def _check_content(path: Path, data: bytes) -> None:
    """Refuse what no head of ours has: operators with graphs of their own, which may never end, and numbers
    in other files. Before the file is loaded, because loading runs what is constant."""
    try:
        for field, graph in _fields(data):
            if field == 25:  # ModelProto.functions
                raise FormatError(f"{path}: operators: expected none of the file's own, got a function")
            if field == 7 and isinstance(graph, bytes):
                _check_graph(path, graph)
    except _ProtobufError as error:
        raise FormatError(f"{path}: expected an ONNX graph, got: {error}") from error


def _check_graph(path: Path, graph: bytes) -> None:
    for field, item in _fields(graph):
        if field not in (1, 5) or not isinstance(item, bytes):
            continue
        parts = list(_fields(item))
        if field == 5 and any(inner in (13, 14) and value for inner, value in parts):  # TensorProto
            raise FormatError(f"{path}: expected its numbers in the file itself, got a reference to another")
        if field == 1:  # NodeProto
            name = b"".join(value for inner, value in parts if inner == 4 and isinstance(value, bytes))
            if name in (b"Loop", b"Scan", b"If"):
                raise FormatError(f"{path}: operators: expected no {name.decode()} in a head")


def _check_ports(path: Path, kind: str, ports: Sequence[Any], expected: dict[str, int]) -> None:
    got = {port.name: port for port in ports}
    if set(got) != set(expected):
        raise FormatError(f"{path}: {kind}s: expected {sorted(expected)}, got {sorted(got)}")
    for name, width in expected.items():
        port = got[name]
        fits = len(port.shape) == 2 and not isinstance(port.shape[0], int) and port.shape[1] == width
        if not fits or port.type != "tensor(float)":
            raise FormatError(f"{path}: {name}: expected float [n, {width}], got {port.type} {port.shape}")


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def count_parameters(data: bytes) -> int:
    """Numbers in the constant tensors of an ONNX file: ModelProto.graph (7) .initializer (5) .dims (1)."""
    total = 0
    for number, graph in _fields(data):
        if number != 7 or not isinstance(graph, bytes):
            continue
        for inner, tensor in _fields(graph):
            if inner == 5 and isinstance(tensor, bytes):
                total += math.prod(_dims(tensor))
    return total


def _dims(tensor: bytes) -> Iterator[int]:
    for number, value in _fields(tensor):
        if number == 1 and isinstance(value, int):
            yield value
        elif number == 1 and isinstance(value, bytes):  # packed
            at = 0
            while at < len(value):
                item, at = _varint(value, at)
                yield item


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Fields of a protobuf message: number, and an integer or the bytes."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        wire = key & 7
        if wire == 0:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        if wire == 2:
            size, at = _varint(data, at)
        elif wire in (1, 5):
            size = 8 if wire == 1 else 4
        else:
            raise _ProtobufError(f"head.onnx: expected a protobuf message, got wire type {wire}")
        yield key >> 3, data[at : at + size]
        at += size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data):
        value |= (data[at] & 127) << shift
        at += 1
        if data[at - 1] < 128:
            return value, at
        shift += 7
    raise _ProtobufError("head.onnx: expected a protobuf message, got one cut short")
