"""Writer of the head of Volume Feature Rendering as one ONNX graph, which maps composited features and a
direction to rgb.

The graph, its letters and its rounding to 8 bits are specified in `player.head.graph`; this module adds the
weights. The spherical harmonics are computed inside the graph from the one table of
`exporters.head.spherical_harmonics`, so that no caller can disagree with it on order or sign. The graph is
built from numpy arrays, and the same weights give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exporters.extras import needs
from exporters.head.spherical_harmonics import sh_monomials
from player.errors import FormatError, ShapeError
from player.head.graph import (
    IR_VERSION,
    OPSET,
    PAIR_LIMIT,
    Activation,
    HeadForm,
    head_nodes,
    head_ports,
    monomials,
    pair_sums,
    read_head,
)

Layer = tuple[np.ndarray, np.ndarray]
"""Weights [n_in, n_out] and bias [n_out]."""

Range = tuple[float, float]
"""Smallest and largest value of an activation, smallest <= 0 <= largest."""


@dataclass(frozen=True)
class HeadWeights:
    """The head's arrays, any float type; layers as (W [n_in, n_out], b [n_out]).

    Args:
        spatial: hidden layers on the composited features, at least one.
        to_sh: h -> the spherical-harmonics features, [n_hidden, n_bases * n_sh_features], basis-major.
        directional_first: (D_bottleneck [n_hidden, n_out], D_sh [n_bases * n_sh_features, n_out], b [n_out]).
        directional: more hidden layers; may be empty.
        output: the last layer, [n_in, 3], followed by a sigmoid.
        sh_degree: number of bands, 1 to 8; n_bases = sh_degree^2.
        n_sh_features: features a basis.
        activation: the function applied after each hidden layer.

    Raises:
        ShapeError: two layers do not fit.
        FormatError: a weight is NaN or infinite.
    """

    spatial: tuple[Layer, ...]
    to_sh: Layer
    directional_first: tuple[np.ndarray, np.ndarray, np.ndarray]
    directional: tuple[Layer, ...]
    output: Layer
    sh_degree: int
    n_sh_features: int
    activation: Activation = "gelu"

    def __post_init__(self) -> None:
        if not self.spatial:
            raise ShapeError("head: spatial: expected at least one layer, got none")
        width = self.n_channels
        for index, layer in enumerate(self.spatial):
            width = _check_layer(f"spatial[{index}]", layer, width)
        n_encoded = self.sh_degree**2 * self.n_sh_features
        _check_layer("to_sh", self.to_sh, width, n_encoded)
        d_bottleneck, d_sh, bias = self.directional_first
        n_first = _check_layer("directional_first (bottleneck)", (d_bottleneck, bias), width)
        width = _check_layer("directional_first (sh)", (d_sh, bias), n_encoded, n_first)
        for index, layer in enumerate(self.directional):
            width = _check_layer(f"directional[{index}]", layer, width)
        _check_layer("output", self.output, width, 3)

    @property
    def n_channels(self) -> int:
        """Channels of the composited features."""
        return self.spatial[0][0].shape[0]


def _check_layer(name: str, layer: Layer, n_in: int, n_out: int | None = None) -> int:
    weights, bias = layer
    width = weights.shape[-1] if n_out is None else n_out
    if weights.shape != (n_in, width) or bias.shape != (width,):
        raise ShapeError(
            f"head: {name}: expected [{n_in}, {width}] and [{width}], got {weights.shape} and {bias.shape}"
        )
    if not (np.isfinite(weights).all() and np.isfinite(bias).all()):
        raise FormatError(f"head: {name}: expected finite weights, got NaN or infinity")
    return width


def head_onnx(weights: HeadWeights, ranges: Sequence[Range] | None = None) -> bytes:
    """Return the head as a serialised ONNX model (opset 20, any number of pixels).

    Inputs `features` [n, n_channels] (composited, not divided by the opacity) and `dirs` [n, 3] (unit, from
    the camera into the scene); output `rgb` [n, 3] sRGB in [0, 1]; all float32.

    Args:
        weights: the head.
        ranges: None for float32 throughout; else the ranges of h, of e and of each z but the last, as
            `exporters.head.ranges.activation_ranges` finds them. The wide layers then multiply in 8 bits, in
            the standard QuantizeLinear/DequantizeLinear form. Ranges are constants of the graph, so a
            pixel's colour does not depend on which pixels it is evaluated with.

    Raises:
        ShapeError: the number of ranges does not fit the head.
        FormatError: no player would take the head, for example because it has too many layers.
        MissingExtraError: the package `onnx` is not installed.
    """
    with needs("the ONNX head", "the package onnx"):
        import onnx
        from onnx import helper, numpy_helper
    if ranges is not None and len(ranges) != 2 + len(weights.directional):
        raise ShapeError(f"head: ranges: expected {2 + len(weights.directional)}, got {len(ranges)}")
    form = HeadForm(
        len(weights.spatial),
        len(weights.directional),
        weights.sh_degree,
        ranges is not None,
        weights.activation,
        ranges is not None,
    )
    nodes = [
        helper.make_node(node.operator, node.inputs, [node.output], node.output, **node.attributes)
        for node in head_nodes(form)
    ]
    tensors = [
        numpy_helper.from_array(np.ascontiguousarray(array), name)
        for name, array in _constants(weights, ranges).items()
    ]
    inputs, outputs = (
        [
            helper.make_tensor_value_info(port.name, onnx.TensorProto.FLOAT, ["n", port.width])
            for port in ports
        ]
        for ports in head_ports(weights.n_channels)
    )
    model = helper.make_model(
        helper.make_graph(nodes, "vfr_head", inputs, outputs, tensors),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="vfr-bake",
    )
    onnx.checker.check_model(model, full_check=True)
    data = model.SerializeToString(deterministic=True)
    read_head(data, "head")  # checks that a player can read it
    return data


def levels(limits: Range) -> tuple[float, int]:
    """Return the quantization step between the 256 levels of a range, and the code of 0.

    >>> levels((-0.1, 25.4))
    (0.1, 1)
    """
    scale = max((limits[1] - limits[0]) / 255, 1e-12)
    return scale, int(np.clip(np.rint(-limits[0] / scale), 0, 255))


def weight_scales(weight: np.ndarray) -> np.ndarray:
    """Return the quantization step of the codes of the weights [n_in, n_out], for each
    output: [n_out] float32.

    With these steps the magnitudes of two neighbouring codes add up to `player.head.graph.PAIR_LIMIT` at
    most: before rounding their sum is at most one less, and rounding may raise each by a half.
    """
    return (np.maximum(pair_sums(weight).max(axis=0), 1e-12) / (PAIR_LIMIT - 1)).astype(np.float32)


def _constants(weights: HeadWeights, ranges: Sequence[Range] | None) -> dict[str, np.ndarray]:
    """Return the graph's constants by name."""
    constants: dict[str, np.ndarray] = {}

    def dense(name: str, layer: Layer, x: str = "", parts: Sequence[str] = ("weight", "bias")) -> None:
        """Add the parts of a layer, in 8 bits if its input `x` is in 8 bits."""
        x_scale = constants.get(f"{x}_scale")
        if x_scale is None:
            for part, array in zip(parts, layer, strict=False):
                constants[f"{name}_{part}"] = array.astype(np.float32)
            return
        in_8_bits = _in_8_bits(layer, x_scale[0])
        for part in parts:
            codes, scale = in_8_bits[part]
            constants[f"{name}_{part}_codes"], constants[f"{name}_{part}_scale"] = codes, scale
            constants[f"{name}_{part}_zero"] = np.zeros(len(scale), codes.dtype)

    def in_codes(x: str, index: int) -> None:
        if ranges is not None:
            scale, zero = levels(ranges[index])
            constants[f"{x}_scale"] = np.array([scale], np.float32)
            constants[f"{x}_zero"] = np.array([zero], np.uint8)

    for index, layer in enumerate(weights.spatial):
        dense(f"spatial_{index}", layer)
    h = f"spatial_{len(weights.spatial) - 1}"
    in_codes(h, 0)
    dense("to_sh", weights.to_sh, h)
    constants.update(_harmonics(weights))
    d_bottleneck, d_sh, bias = weights.directional_first
    dense("directional_0_bottleneck", (d_bottleneck, bias), h)
    in_codes("sh_encoded", 1)
    dense("directional_0_sh", (d_sh, np.zeros_like(bias)), "sh_encoded", ["weight"])
    for index, layer in enumerate(weights.directional, start=1):
        in_codes(f"directional_{index - 1}", index + 1)
        dense(f"directional_{index}", layer, f"directional_{index - 1}")
    dense("output", weights.output)
    return constants


def _in_8_bits(layer: Layer, x_scale: np.float32) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the weights as signed 8-bit codes with a scale for each output, and the bias as codes in steps
    of the products' scale.

    A bias that is huge beside its weights makes the steps coarser, because its code has to fit into 32 bits.
    """
    weight, bias = layer
    smallest = np.abs(bias) / (float(x_scale) * 2**30)
    scales = np.maximum(weight_scales(weight), smallest).astype(np.float32)
    products = scales * x_scale
    codes = np.rint(weight / scales).astype(np.int8)
    bias_codes = np.rint(bias / products.astype(np.float64)).astype(np.int32)
    return {"weight": (codes, scales), "bias": (bias_codes, products)}


def _harmonics(weights: HeadWeights) -> dict[str, np.ndarray]:
    """Return the constants that compute the monomials of every order from those of the order below, and the
    coefficients of each basis function, repeated `n_sh_features` times."""
    exponents, coefficients = sh_monomials(weights.sh_degree)
    columns = np.repeat(coefficients, weights.n_sh_features, axis=1).astype(np.float32)
    of_powers = {tuple(powers): columns[row] for row, powers in enumerate(exponents.tolist())}
    constants = {"sh_bias": of_powers.pop((0, 0, 0))}
    rows: list[np.ndarray] = []
    for order in range(1, weights.sh_degree):
        powers, parents, axes = monomials(order)
        rows += [of_powers.get(p, np.zeros(columns.shape[1], np.float32)) for p in powers]
        if order > 1:
            n_below = order * (order + 1) // 2
            constants[f"sh_{order}_parent_pick"] = np.eye(n_below, dtype=np.float32)[:, parents]
            constants[f"sh_{order}_axis_pick"] = np.eye(3, dtype=np.float32)[:, axes]
    if rows:
        constants["sh_weight"] = np.array(rows)
    return constants
