"""The head of Volume Feature Rendering as one ONNX graph: composited features and a direction in, rgb out.

With F the composited `features` of a pixel and d its unit direction (row vectors, y = x @ W + b):
    h   = gelu(... gelu(F S0 + s0) ...)                      spatial layers
    e   = (h Wf + bf) * repeat(Y(d), n_sh_features)          spherical-harmonics encoding, basis-major
    z   = gelu(h D_bottleneck + e D_sh + d0)                 first directional layer, bottleneck folded
    rgb = sigmoid(gelu(... gelu(z D1 + d1) ...) W + b)       more directional layers, output
gelu(x) = x (1 + erf(x / sqrt 2)) / 2, the exact form. Y is computed inside the graph from the one table of
`exporters.spherical_harmonics`, so that no caller can disagree with it on order or sign: powers of d, a
product with a constant matrix. Built from numpy arrays, the same weights give the same bytes.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from exporters.spherical_harmonics import sh_monomials
from player.errors import FormatError, MissingExtraError, ShapeError

OPSET = 20
"""The first operator set with a native Gelu."""
IR_VERSION = 10

Layer = tuple[np.ndarray, np.ndarray]
"""Weights [n_in, n_out] and bias [n_out]."""

Range = tuple[float, float]
"""Smallest and largest value of an activation, smallest <= 0 <= largest."""


@dataclass(frozen=True)
class HeadWeights:
    """The head's arrays, any float type; layers as (W [n_in, n_out], b [n_out]).

    Args:
        spatial: hidden layers on the composited features, each followed by GELU; at least one.
        to_sh: h -> the spherical-harmonics features, [n_hidden, n_bases * n_sh_features], basis-major.
        directional_first: (D_bottleneck [n_hidden, n_out], D_sh [n_bases * n_sh_features, n_out], b [n_out]).
        directional: more hidden layers, each followed by GELU; may be empty.
        output: the last layer, [n_in, 3], followed by a sigmoid.
        sh_degree: number of bands, 1 to 8; n_bases = sh_degree^2.
        n_sh_features: features a basis.

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
    """The head as a serialised ONNX model (opset 20, any number of pixels).

    Inputs `features` [n, n_channels] (composited, not divided by the opacity) and `dirs` [n, 3] (unit, from
    the camera into the scene); output `rgb` [n, 3] sRGB in [0, 1]; all float32.

    Args:
        weights: the head.
        ranges: None for float32 throughout; else one range for each hidden activation, as
            `exporters.int8_head.activation_ranges` finds them. The wide layers then multiply in 8 bits, in
            the standard QuantizeLinear/DequantizeLinear form. Ranges are constants of the graph, so a
            pixel's colour does not depend on which pixels it is evaluated with.

    Raises:
        MissingExtraError: the package `onnx` is not installed.
    """
    try:
        import onnx
        from onnx import helper
    except ImportError as error:
        raise MissingExtraError(
            "the ONNX head: needs the package onnx: pip install vfr-bake[export]"
        ) from error
    graph = _Graph(helper, onnx.numpy_helper)
    h = "features"
    for index, layer in enumerate(weights.spatial):
        h = graph.dense(f"spatial_{index}", h, *layer, activation="Gelu")
    if ranges is not None:
        if len(ranges) != 1 + len(weights.directional):
            raise ShapeError(f"head: ranges: expected {1 + len(weights.directional)}, got {len(ranges)}")
        h = graph.quantized(h, ranges[0])
    f = graph.dense("to_sh", h, *weights.to_sh)
    e = graph.add("Mul", [f, _harmonics(graph, weights)], "sh_encoded")
    d_bottleneck, d_sh, bias = weights.directional_first
    z = graph.dense("directional_0_bottleneck", h, d_bottleneck, bias)
    z = graph.add("Gemm", [e, graph.constant("directional_0_sh_weight", d_sh), z], "directional_0_linear")
    z = graph.add("Gelu", [z], "directional_0", approximate="none")
    for index, layer in enumerate(weights.directional, start=1):
        if ranges is not None:
            z = graph.quantized(z, ranges[index])
        z = graph.dense(f"directional_{index}", z, *layer, activation="Gelu")
    z = graph.dense("output", z, *weights.output)
    graph.add("Sigmoid", [z], "rgb")

    def tensor(name: str, width: int) -> Any:
        return helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["n", width])

    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "vfr_head",
            [tensor("features", weights.n_channels), tensor("dirs", 3)],
            [tensor("rgb", 3)],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="vfr-bake",
    )
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def levels(limits: Range) -> tuple[float, int]:
    """What a step between the 256 levels of a range counts, and the code of 0.

    >>> levels((-0.1, 25.4))
    (0.1, 1)
    """
    scale = max((limits[1] - limits[0]) / 255, 1e-12)
    return scale, int(np.clip(np.rint(-limits[0] / scale), 0, 255))


class _Graph:
    """Nodes and constants collected in order."""

    def __init__(self, helper: Any, numpy_helper: Any) -> None:
        self._helper = helper
        self._numpy_helper = numpy_helper
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._scales: dict[str, float] = {}  # of the tensors that have 8 bits

    def constant(self, name: str, array: np.ndarray) -> str:
        """A constant: 8-bit and 32-bit integers as they are, other integers as int64, the rest as float32."""
        kind: Any = array.dtype
        if kind not in (np.int8, np.uint8, np.int32):
            kind = np.int64 if kind.kind == "i" else np.float32
        self.constants.append(self._numpy_helper.from_array(np.ascontiguousarray(array, kind), name))
        return name

    def add(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(self._helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def dense(
        self, name: str, x: str, weight: np.ndarray, bias: np.ndarray, activation: str | None = None
    ) -> str:
        if x in self._scales:
            inputs = [x, *self._quantized_layer(name, weight, bias, self._scales[x])]
        else:
            inputs = [x, self.constant(f"{name}_weight", weight), self.constant(f"{name}_bias", bias)]
        linear = self.add("Gemm", inputs, f"{name}_linear")
        return self.add(activation, [linear], name, approximate="none") if activation else linear

    def quantized(self, x: str, limits: Range) -> str:
        """`x` rounded to 256 levels between its limits, zero among them; what follows may multiply in 8
        bits."""
        scale, zero = levels(limits)
        steps = [
            self.constant(f"{x}_scale", np.array(scale)),
            self.constant(f"{x}_zero", np.array(zero, np.uint8)),
        ]
        self.add("QuantizeLinear", [x, *steps], f"{x}_codes")
        out = self.add("DequantizeLinear", [f"{x}_codes", *steps], f"{x}_rounded")
        self._scales[out] = float(np.float32(scale))
        return out

    def _quantized_layer(self, name: str, weight: np.ndarray, bias: np.ndarray, x_scale: float) -> list[str]:
        """Weights with signed 8-bit codes, a scale for each output; the bias in steps of the products'
        scale."""
        scales = np.maximum(np.abs(weight).max(axis=0), 1e-12) / 127
        scales = scales.astype(np.float32)
        codes = np.clip(np.rint(weight / scales), -127, 127).astype(np.int8)
        product_scales = scales * np.float32(x_scale)
        bias_codes = np.clip(np.rint(bias / product_scales.astype(np.float64)), -(2**31) + 1, 2**31 - 1)
        n = len(scales)
        inputs = []
        for part, values, steps in (
            ("weight", codes, scales), ("bias", bias_codes.astype(np.int32), product_scales)
        ):  # fmt: skip
            zero = np.zeros(n, values.dtype)
            parts = [
                self.constant(f"{name}_{part}_codes", values),
                self.constant(f"{name}_{part}_scale", steps),
                self.constant(f"{name}_{part}_zero", zero),
            ]
            axis = values.ndim - 1
            inputs.append(self.add("DequantizeLinear", parts, f"{name}_{part}", axis=axis))
        return inputs


def _harmonics(graph: _Graph, weights: HeadWeights) -> str:
    """Y(dirs), each basis repeated `n_sh_features` times: monomials of every order, then one matrix product.

    A monomial of order k is one of order k - 1 times x, y or z.
    """
    exponents, coefficients = sh_monomials(weights.sh_degree)
    columns = np.repeat(coefficients, weights.n_sh_features, axis=1)
    parts, rows, previous, name = [], [], [(1, 0, 0), (0, 1, 0), (0, 0, 1)], "dirs"
    wanted = {tuple(powers): row for row, powers in enumerate(exponents.tolist())}
    for order in range(1, weights.sh_degree):
        if order > 1:
            current = [p for p in itertools.product(range(order, -1, -1), repeat=3) if sum(p) == order]
            axes = [int(np.argmax(np.array(powers) > 0)) for powers in current]
            parents = [
                previous.index(tuple(power - (axis == k) for k, power in enumerate(powers)))  # type: ignore[arg-type]
                for powers, axis in zip(current, axes, strict=True)
            ]
            # Columns are picked by a product with zeros and ones: exact, and much faster than Gather.
            factors = [
                graph.add(
                    "MatMul",
                    [source, graph.constant(f"sh_{order}_{kind}_pick", np.eye(width)[:, index])],
                    f"sh_{order}_{kind}",
                )
                for kind, source, width, index in (
                    ("parent", name, len(previous), parents), ("axis", "dirs", 3, axes)
                )
            ]  # fmt: skip
            name = graph.add("Mul", factors, f"sh_{order}")
            previous = current
        parts.append(name)
        rows += [columns[wanted[p]] if p in wanted else np.zeros(columns.shape[1]) for p in previous]
    constant = graph.constant("sh_bias", columns[0])
    if not parts:  # one band: the constant alone broadcasts over the pixels
        return constant
    monomials = graph.add("Concat", parts, "sh_monomials", axis=1) if len(parts) > 1 else parts[0]
    return graph.add("Gemm", [monomials, graph.constant("sh_weight", np.array(rows)), constant], "sh")
