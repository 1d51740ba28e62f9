"""The head: turns the composited features of a pixel and its direction into the pixel's colour, by compiled
code or by onnxruntime.

Each of these is imported only when a head that needs it is opened, so that `vfr-play --help` answers at once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from player.asset.asset import Asset
from player.errors import FormatError
from player.head.graph import HeadArrays, read_head

CHUNK = 2048
"""Pixels per run: the activations of a layer of width 256 (2 MB) then stay in the second-level cache, which
is 25-45 % faster than running all pixels at once."""

Run = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Head:
    """An open head; may be called from several threads at a time.

    Each call runs on its caller's thread alone: the player works on many tiles at once, so that no core is
    idle.
    """

    def __init__(
        self, data: bytes, n_channels: int, compiled: bool = False, where: str = "head.onnx"
    ) -> None:
        """Open a head.

        Args:
            data: the bytes of its file.
            n_channels: number of features of a pixel.
            compiled: let numba run the head if it is in 8 bits (`player.head.compiled`). onnxruntime runs a
                head in float32, faster than numba would.
            where: the file's name in error messages.

        Raises:
            FormatError: the bytes are not the graph of a head that takes `n_channels` features.
        """
        self._where, arrays = where, _checked(data, n_channels, where)
        self._run = _compile(arrays) if compiled and arrays.form.in_8_bits else _open_session(data, arrays)

    @classmethod
    def of(cls, asset: Asset, compiled: bool = False) -> Head:
        """Open the head of an asset. Raises FormatError as `asset_head`."""
        name = str(asset.path("head.onnx"))
        return cls(asset.read("head.onnx"), asset.manifest.n_channels, compiled, name)

    def __call__(self, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """Compute the colours of n pixels.

        Args:
            features: [n, n_channels] float32 composited features.
            dirs: [n, 3] float32 unit directions, model frame.

        Returns:
            rgb: [n, 3] float32, 0..1, in the manifest's colour space.

        Raises:
            FormatError: a colour is not finite, because weights are so large that a sum overflows float32.
        """
        rgb = np.empty((len(features), 3), np.float32)
        for start in range(0, len(features), CHUNK):
            part = slice(start, start + CHUNK)
            rgb[part] = self._run(features[part], dirs[part])
        if not np.isfinite(rgb).all():
            raise FormatError(f"{self._where}: rgb: expected {len(rgb)} finite colours, got NaN or infinity")
        return rgb


def asset_head(asset: Asset) -> HeadArrays:
    """Return the numbers of an asset's head.

    Raises:
        FormatError: the file is not the graph of a head that takes the asset's channels; IntegrityError: it
            is not the file that the manifest lists.
    """
    return _checked(asset.read("head.onnx"), asset.manifest.n_channels, str(asset.path("head.onnx")))


def _checked(data: bytes, n_channels: int, where: str) -> HeadArrays:
    arrays = read_head(data, where)
    if arrays.n_channels != n_channels:
        raise FormatError(
            f"{where}: features: expected float [n, {n_channels}], got [n, {arrays.n_channels}]"
        )
    return arrays


def _compile(arrays: HeadArrays) -> Run:
    from player.head.compiled import CompiledHead
    from player.head.program import program_of

    return CompiledHead(program_of(arrays))


def _open_session(data: bytes, arrays: HeadArrays) -> Run:
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if arrays.may_saturate:  # slower products of bytes, which fit into 16 bits on every processor
        options.add_session_config_entry("session.x64quantprecision", "1")
    options.log_severity_level = 3
    session = ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def run(features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        return np.asarray(session.run(["rgb"], {"features": features, "dirs": dirs})[0])

    return run
