"""Heads as earlier versions wrote them, and 8-bit heads evaluated in integers, as with or without VNNI."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from unittest import mock

import numpy as np
import onnx
from scipy.special import expit

from exporters.head import onnx_head
from exporters.head.onnx_head import HeadWeights, Range, head_onnx
from player.head.graph import HeadArrays, Layer, Rounding, head_nodes, read_head
from tests.reference import ACTIVATIONS


def head_onnx_of_before(weights: HeadWeights, ranges: list[Range]) -> bytes:
    """Return the file of an 8-bit head as versions before 0.1.0 wrote it: codes of weights are up to 127,
    whatever their neighbours."""

    def scales(weight: np.ndarray) -> np.ndarray:
        return (np.maximum(np.abs(weight).max(axis=0), 1e-12) / 127).astype(np.float32)

    with mock.patch.object(onnx_head, "weight_scales", scales):
        return head_onnx_with_floats(weights, ranges)


def head_onnx_with_floats(weights: HeadWeights, ranges: Sequence[Range]) -> bytes:
    """Return the file of an 8-bit head as it was written when encoded features (e) were not rounded."""
    data = head_onnx(weights, ranges)
    model, form = onnx.load_from_string(data), replace(read_head(data, "head").form, rounds_encoded=False)
    constants, gone = model.graph.initializer, ("sh_encoded_", "directional_0_sh_weight_")
    kept = [constant for constant in constants if not constant.name.startswith(gone)]
    from_sh = weights.directional_first[1].astype(np.float32)
    kept.append(onnx.numpy_helper.from_array(from_sh, "directional_0_sh_weight"))
    del model.graph.node[:], constants[:]
    constants.extend(kept)
    for node in head_nodes(form):
        made = onnx.helper.make_node(
            node.operator, node.inputs, [node.output], node.output, **node.attributes
        )
        model.graph.node.append(made)
    return model.SerializeToString(deterministic=True)


def play_in_integers(
    head: HeadArrays, features: np.ndarray, dirs: np.ndarray, saturating: bool = False
) -> np.ndarray:
    """Evaluate a head in 8 bits to rgb [n, 3]: layers of codes in integers, the others in float64.

    saturating: products of the inputs 2i and 2i + 1 are added in 16 bits and clipped to -32768..32767, as
    onnxruntime does on processors with AVX2 that have no VNNI.
    """
    activation, roundings = ACTIVATIONS[head.form.activation], iter(head.roundings)
    h = features.astype(np.float64)
    for layer in head.spatial:
        h = activation(_plain(h, layer))
    codes, zero = _codes(h, next(roundings))
    exponents = np.array(_exponents(head.form.sh_degree)).reshape(-1, 3)
    terms = np.prod(dirs[:, None].astype(np.float64) ** exponents, axis=-1)
    encoded = _in_codes(codes, zero, head.to_sh, saturating) * _plain(terms, head.harmonics)
    z = _in_codes(codes, zero, head.bottleneck, saturating)
    if head.of_encoded is None:
        z += _plain(encoded, head.from_sh)
    else:
        z += _in_codes(*_codes(encoded, head.of_encoded), head.from_sh, saturating)
    z = activation(z)
    for layer in head.directional:
        codes, zero = _codes(z, next(roundings))
        z = activation(_in_codes(codes, zero, layer, saturating))
    return expit(_plain(z, head.output))


def _exponents(sh_degree: int) -> list[tuple[int, int, int]]:
    """Return the powers of x, y and z in all monomials from order 1 on, by order, x's power, y's power."""
    return [
        (x, y, order - x - y)
        for order in range(1, sh_degree)
        for x in range(order, -1, -1)
        for y in range(order - x, -1, -1)
    ]


def _plain(x: np.ndarray, layer: Layer) -> np.ndarray:
    return x @ layer.weight.astype(np.float64) + layer.bias


def _codes(x: np.ndarray, rounding: Rounding) -> tuple[np.ndarray, int]:
    levels = np.rint(x / np.float64(rounding.scale)) + rounding.zero
    return np.clip(levels, 0, 255).astype(np.int64), rounding.zero


def _in_codes(codes: np.ndarray, zero: int, layer: Layer, saturating: bool) -> np.ndarray:
    weight = layer.weight.astype(np.int64)
    if len(weight) % 2:
        codes, weight = np.pad(codes, ((0, 0), (0, 1))), np.pad(weight, ((0, 1), (0, 0)))
    products = codes[:, :, None] * weight
    pairs = products[:, ::2] + products[:, 1::2]
    if saturating:
        pairs = np.clip(pairs, -(2**15), 2**15 - 1)
    sums = pairs.sum(axis=1) - zero * weight.sum(axis=0) + layer.bias
    assert layer.scale is not None
    return sums * layer.scale.astype(np.float64)
