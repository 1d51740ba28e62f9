"""The head of an asset as an ONNX file for other programs: alone, or with the decode of features in front.

| graph | inputs | output |
|---|---|---|
| alone | `features` float [n, n_channels], `dirs` float [n, 3] | `rgb` float [n, 3] |
| with decode | `codes` int8 [n, k, n_channels], `weights` float [n, k], `dirs` float [n, 3] | the same |

n and k are free. `features` are the sum of weight times code that a player composites; the bake has put the
scales of the codes into the head's first layer. With the decode, `codes` are k rows of features.codes, and
`weights` are their weights, each a compositing weight times the interpolation weight of a corner; `features =
sum_k weights codes` is then part of the graph. `dirs` are unit, model frame, from the camera into the scene;
`rgb` is 0..1 in the asset's colour space, to be composited as `rgb A + (1 - A) background`.

The file's metadata records the opset, the names of inputs and outputs, what the graph was compared with, and
the largest difference.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from exporters.extras import needs
from player.asset.asset import Asset
from player.errors import FormatError, ParityError
from player.head.head import Head, asset_head

TOLERANCE = 1e-6
"""Largest allowed difference of rgb from the asset's own head. Both compute the same graph on numbers that
are exact in float32, so that only the order of float32 additions may differ."""

N_FETCHES = 5
"""Feature lookups per pixel, k, in the comparisons."""


class Comparison(NamedTuple):
    """Inputs for which two heads are compared."""

    label: str
    """Name of these inputs in an error message."""
    features: np.ndarray
    """[n, n_channels] float32."""
    codes: np.ndarray | None
    """[n, k, n_channels] int8, whose sum weighted by `weights` is `features`; None if the features are not
    made of codes."""
    weights: np.ndarray | None
    """[n, k] float32 weights of the codes; None without codes."""
    dirs: np.ndarray
    """[n, 3] float32, unit."""


def head_bytes(asset: Asset, decode: bool = False, where: str = "head.onnx") -> bytes:
    """Return the file's content; the same asset gives the same bytes.

    The graph is checked by `onnx.checker`, run in onnxruntime, and compared with `player.head.head.Head` on
    random and extreme inputs.

    Args:
        asset: an open asset.
        decode: take codes and weights instead of composited features.
        where: the file's name in error messages.

    Raises:
        FormatError: the asset's head is no valid ONNX.
        ParityError: colours differ from the asset's own head.
        MissingExtraError: the package `onnx` is not installed.
    """
    with needs("ONNX", "the package onnx"):
        import onnx
    data = asset.read("head.onnx")
    model = onnx.load_from_string(data)
    if asset_head(asset).may_saturate:
        _make_weights_unsigned(onnx, model)
    if decode:
        _put_decode_in_front(onnx, model, asset.manifest.n_channels)
    del model.metadata_props[:]
    worst = _compare(asset, model.SerializeToString(deterministic=True), decode, where)
    notes = {
        "vfr.opset": str(
            max(entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx"))
        ),
        "vfr.inputs": ", ".join(value.name for value in model.graph.input),
        "vfr.outputs": "rgb",
        "vfr.colour_space": asset.manifest.colour_space,
        "vfr.layers": "int8" if any(n.op_type == "DequantizeLinear" for n in model.graph.node) else "float32",
        "vfr.compared_with": "the asset's own head in onnxruntime, random and extreme inputs",
        "vfr.tolerance": f"{TOLERANCE:g}",
        "vfr.worst_difference": f"{worst:.3g}",
    }
    for key, value in sorted(notes.items()):
        model.metadata_props.add(key=key, value=value)
    try:
        onnx.checker.check_model(model, full_check=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        raise FormatError(f"{where}: expected a valid ONNX graph: {str(error).splitlines()[0]}") from error
    data = model.SerializeToString(deterministic=True)
    _compare(asset, data, decode, where)
    return data


def _make_weights_unsigned(onnx: Any, model: Any) -> None:
    """Store the codes of weights as unsigned bytes around 128, which represent the same numbers. Every
    processor multiplies these exactly, while on some of them onnxruntime adds up products of an unsigned and
    a signed byte in 16 bits."""
    to_array, from_array = onnx.numpy_helper.to_array, onnx.numpy_helper.from_array
    for tensor in model.graph.initializer:
        if tensor.name.endswith(("_weight_codes", "_weight_zero")):
            codes = to_array(tensor).astype(np.int16) + 128
            tensor.CopyFrom(from_array(codes.astype(np.uint8), tensor.name))


def _put_decode_in_front(onnx: Any, model: Any, n_channels: int) -> None:
    """Compute `features = squeeze(weights [n, 1, k] @ codes [n, k, c])` in the graph, in place
    of the input `features`."""
    helper, graph = onnx.helper, model.graph
    axis = onnx.numpy_helper.from_array(np.array([1], np.int64), "decode_axis")
    nodes = [
        helper.make_node("Cast", ["codes"], ["decode_codes"], "decode_codes", to=onnx.TensorProto.FLOAT),
        helper.make_node("Unsqueeze", ["weights", "decode_axis"], ["decode_weights"], "decode_weights"),
        helper.make_node("MatMul", ["decode_weights", "decode_codes"], ["decode_sum"], "decode_sum"),
        helper.make_node("Squeeze", ["decode_sum", "decode_axis"], ["features"], "features"),
    ]
    old = list(graph.node)
    del graph.node[:]
    graph.node.extend([*nodes, *old])
    graph.initializer.append(axis)
    inputs = [
        helper.make_tensor_value_info("codes", onnx.TensorProto.INT8, ["n", "k", n_channels]),
        helper.make_tensor_value_info("weights", onnx.TensorProto.FLOAT, ["n", "k"]),
        *(value for value in graph.input if value.name != "features"),
    ]
    del graph.input[:]
    graph.input.extend(inputs)


def _compare(asset: Asset, data: bytes, decode: bool, where: str) -> float:
    """Return the largest difference of rgb from the asset's own head; raise ParityError
    if it is over TOLERANCE."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    head = Head.of(asset)
    worst = 0.0
    for label, features, codes, weights, dirs in comparisons(asset.manifest.n_channels):
        if decode and codes is None:
            continue
        inputs = {"codes": codes, "weights": weights} if decode else {"features": features}
        got = np.asarray(session.run(["rgb"], {**inputs, "dirs": dirs})[0])
        expected = head(features, dirs)
        if got.shape != expected.shape:
            raise ParityError(f"{where}: rgb, {label}: expected {expected.shape}, got {got.shape}")
        if not len(got):
            continue
        difference = np.abs(got.astype(np.float64) - expected)
        difference[np.isnan(got) & np.isnan(expected)] = 0  # both overflow float32: no difference
        if not (difference <= TOLERANCE).all():
            pixel = int(np.argmax(np.where(np.isnan(difference), np.inf, difference).max(axis=-1)))
            raise ParityError(
                f"{where}: rgb, {label}: pixel {pixel}: expected {expected[pixel].tolist()}, "
                f"got {got[pixel].tolist()}, tolerance {TOLERANCE:g}"
            )
        worst = max(worst, float(difference.max()))
    return worst


def comparisons(n_channels: int) -> list[Comparison]:
    """Return random and extreme inputs. Weights are multiples of 1/64 and codes are integers, so that every
    order of addition gives the same float32 features; an 8-bit layer could turn a difference in the last bit
    into a whole level."""
    random = np.random.default_rng(0)

    def unit(n: int) -> np.ndarray:
        dirs = random.normal(size=(n, 3))
        dirs[:6] = np.concatenate([np.eye(3), -np.eye(3)])[: min(n, 6)]
        return (dirs / np.linalg.norm(dirs, axis=-1, keepdims=True)).astype(np.float32)

    def coded(label: str, codes: np.ndarray, weights: np.ndarray) -> Comparison:
        features = np.einsum("nk,nkc->nc", weights, codes.astype(np.float64)).astype(np.float32)
        return Comparison(
            label, features, codes.astype(np.int8), weights.astype(np.float32), unit(len(codes))
        )

    def plain(label: str, features: np.ndarray) -> Comparison:
        return Comparison(label, features.astype(np.float32), None, None, unit(len(features)))

    n = 300
    shape = (n, N_FETCHES, n_channels)
    shares = random.multinomial(64, [1 / (N_FETCHES + 1)] * (N_FETCHES + 1), n)[:, :N_FETCHES] / 64
    signs = np.where(random.random((n, n_channels)) < 0.5, -1.0, 1.0)
    return [
        coded("no pixel", np.zeros((0, *shape[1:])), np.zeros((0, N_FETCHES))),
        coded("one pixel", random.integers(-128, 128, (1, *shape[1:])), shares[:1]),
        coded("random", random.integers(-128, 128, shape), shares),
        coded("one fetch", random.integers(-128, 128, (n, 1, n_channels)), np.ones((n, 1))),
        coded("no light", random.integers(-128, 128, shape), np.zeros((n, N_FETCHES))),
        coded("lowest codes", np.full(shape, -128), np.full((n, N_FETCHES), 0.1875)),
        coded("highest codes", np.full(shape, 127), np.full((n, N_FETCHES), 0.1875)),
        plain("random floats", random.normal(0, 40, (2000, n_channels))),
        plain("subnormal", signs * 1e-40),
        plain("ten thousand", signs * 1e4),
        plain("1e30", signs * 1e30),
    ]
