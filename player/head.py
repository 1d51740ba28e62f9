"""The head: from the composited features of a pixel and its direction to its colour, by onnxruntime.

onnxruntime is imported when a head is opened, not before, so that `vfr-play --help` answers at once.
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

    def __init__(self, path: Path, n_channels: int) -> None:
        import onnxruntime as ort
        from onnxruntime.capi import onnxruntime_pybind11_state as state  # pyright: ignore[reportAttributeAccessIssue]

        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        failures = (
            state.Fail,
            state.InvalidProtobuf,
            state.InvalidGraph,
            state.InvalidArgument,
            state.NotImplemented,
        )
        try:
            session = ort.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
        except (*failures, RuntimeError, ValueError) as error:
            raise FormatError(f"{path}: expected an ONNX graph, got: {_first_line(error)}") from error
        _check_ports(path, "input", session.get_inputs(), {"features": n_channels, "dirs": 3})
        _check_ports(path, "output", session.get_outputs(), {"rgb": 3})
        self._session = session

    def __call__(self, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """Colours of n pixels.

        Args:
            features: [n, n_channels] float32 composited features.
            dirs: [n, 3] float32 unit directions, model frame.

        Returns:
            rgb: [n, 3] float32, 0..1, in the manifest's colour space.
        """
        rgb = np.empty((len(features), 3), np.float32)
        for start in range(0, len(features), CHUNK):
            part = slice(start, start + CHUNK)
            outputs = self._session.run(["rgb"], {"features": features[part], "dirs": dirs[part]})
            rgb[part] = np.asarray(outputs[0])
        return rgb


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
            raise FormatError(f"head.onnx: expected a protobuf message, got wire type {wire}")
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
    raise FormatError("head.onnx: expected a protobuf message, got one cut short")
