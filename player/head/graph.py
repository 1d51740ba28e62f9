"""The only graph that a head can have: its nodes, which `exporters.head.onnx_head` writes, and the reader
that checks a file against them.

For a pixel with composited `features` F and unit direction d (row vectors, y = x @ W + b):
    h   = a(... a(F S0 + s0) ...)                            spatial layers
    e   = (h Wf + bf) * (m(d) C + c)                         spherical-harmonics encoding
    z   = a(h D_bottleneck + e D_sh + d0)                    first directional layer
    rgb = sigmoid(a(... a(z D1 + d1) ...) W + b)             more directional layers, output
The activation a is gelu(x) = x (1 + erf(x / sqrt 2)) / 2, in its exact form, or hard_swish(x) = x min(max(x /
6 + 1/2, 0), 1), which takes a seventh of the operations; it is the same in all layers of a head. m(d) are the
monomials of x, y and z up to the order sh_degree - 1, without the constant; each is the product of a monomial
of the order below and x, y or z. C and c are the coefficients of the spherical harmonics; the column of a
basis function is repeated for each feature that the function multiplies.

In 8 bits, h, e and every z but the last are rounded to 256 levels, and the layers that take them multiply
codes; in older heads e is not rounded. With q the codes of x, q = clip(rint(x / x_scale) + zero, 0, 255), and
Q the codes of W,
    y = ((q - zero) Q + codes of b) * scale
in integers. The `scale` [n_out] of an output is x_scale times the scale of its weights.

A player need not understand any other graph. Compiled code relies on the sizes of these arrays when it writes
to memory; `read_head` checks them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from player.errors import FormatError
from player.head.onnx_file import Graph, Node, Port, read_graph

OPSET = 20
"""The first operator set with a native Gelu."""
IR_VERSION = 10
MAX_DEGREE = 8
MAX_LAYERS = 16
MAX_WIDTH = 4096
LARGEST_SUM = 2**31 - 1
"""Largest sum of products of codes: it is kept in an int32."""
PAIR_LIMIT = 128
"""Largest sum of the magnitudes of two neighbouring weight codes, 2i and 2i + 1, of an output. Some
processors add up two products at a time in 16 bits: 255 times this sum still fits."""

Activation = Literal["gelu", "hard_swish"]


@dataclass(frozen=True)
class HeadForm:
    """The parameters that determine the nodes of a head's graph: everything but the widths of its layers."""

    n_spatial: int
    n_directional: int
    """Number of directional layers after the first."""
    sh_degree: int
    """Number of bands of spherical harmonics."""
    in_8_bits: bool
    activation: Activation
    rounds_encoded: bool
    """Whether e is rounded to 8 bits, too."""


class Layer(NamedTuple):
    """A dense layer, in float32 or in 8 bits."""

    weight: np.ndarray
    """[n_in, n_out] float32, or int8 codes."""
    bias: np.ndarray
    """[n_out] float32, or int32 codes."""
    scale: np.ndarray | None = None
    """[n_out] float32, the factors of the sums of products of codes; None in float32."""


class Rounding(NamedTuple):
    """The rounding of an activation to 8 bits."""

    scale: np.float32
    """Step from one level to the next."""
    zero: int
    """The code of 0."""


@dataclass(frozen=True, eq=False)
class HeadArrays:
    """A head's numbers, checked: the widths of its layers fit, and every number is finite."""

    form: HeadForm
    spatial: list[Layer]
    roundings: list[Rounding]
    """Roundings of h, and of each z that another directional layer takes; empty in float32."""
    of_encoded: Rounding | None
    """Rounding of e, if it is rounded."""
    to_sh: Layer
    harmonics: Layer
    """C [n_monomials, n_encoded] and c, the monomials in the order of `monomials`."""
    bottleneck: Layer
    """D_bottleneck and d0."""
    from_sh: Layer
    """D_sh, without a bias."""
    directional: list[Layer]
    output: Layer
    n_parameters: int
    """Count of the numbers in all constants."""

    @property
    def n_channels(self) -> int:
        """Number of composited features that the head takes."""
        return self.spatial[0].weight.shape[0]

    @property
    def may_saturate(self) -> bool:
        """Whether sums of two products of codes may exceed 16 bits. They may in assets that were written
        before `PAIR_LIMIT` was introduced."""
        layers = [self.to_sh, self.bottleneck, self.from_sh, *self.directional]
        return any(pair_sums(a.weight).max(initial=0) > PAIR_LIMIT for a in layers if a.scale is not None)


def pair_sums(weight: np.ndarray) -> np.ndarray:
    """Return the sums of the magnitudes of the rows 2i and 2i + 1 in each column: [ceil(n_in / 2), n_out].

    >>> pair_sums(np.array([[1, -128], [-3, 100], [5, 0]], np.int8)).tolist()
    [[4, 228], [5, 0]]
    """
    wide = np.abs(weight.astype(np.float64 if weight.dtype.kind == "f" else np.int64))
    return wide[::2] + np.concatenate([wide[1::2], np.zeros((len(wide) % 2, wide.shape[1]), wide.dtype)])


def monomials(order: int) -> tuple[list[tuple[int, int, int]], list[int], list[int]]:
    """List the monomials of one order.

    Returns for each monomial: its powers of x, y and z; and the two factors whose product it is, a monomial
    of the order below (as its index there) and an axis, 0 to 2.

    >>> monomials(1)[0]
    [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    >>> powers, parents, axes = monomials(2)
    >>> powers[1], monomials(1)[0][parents[1]], axes[1]
    ((1, 1, 0), (0, 1, 0), 0)
    """

    def powers_of(n: int) -> list[tuple[int, int, int]]:
        found = itertools.product(range(n, -1, -1), repeat=3)
        return [(x, y, z) for x, y, z in found if x + y + z == n]

    current, below = powers_of(order), powers_of(order - 1)
    axes = [next(k for k in range(3) if powers[k]) for powers in current]
    parents = [
        below.index((x - (axis == 0), y - (axis == 1), z - (axis == 2)))
        for (x, y, z), axis in zip(current, axes, strict=True)
    ]
    return current, parents, axes


def monomial_products(sh_degree: int) -> list[tuple[int, int]]:
    """Return, for each monomial of the orders 1 to `sh_degree` - 1, its two factors: the index of its parent
    in this list (-1 for 1) and an axis, 0 to 2.

    >>> monomial_products(3)[:5]
    [(-1, 0), (-1, 1), (-1, 2), (0, 0), (1, 0)]
    """
    found: list[tuple[int, int]] = []
    below = -1  # where the monomials of the order below begin
    for order in range(1, sh_degree):
        _, parents, axes = monomials(order)
        begin = len(found)
        found += [(below + parent, axis) for parent, axis in zip(parents, axes, strict=True)]
        below = begin
    return found


def head_nodes(form: HeadForm) -> list[Node]:
    """Return the nodes of a head, in the file's order."""
    nodes: list[Node] = []
    rounded: set[str] = set()

    def add(operator: str, inputs: list[str], output: str, **attributes: int | str) -> str:
        nodes.append(Node(operator, tuple(inputs), output, attributes))
        return output

    def dense(name: str, x: str, activated: bool = False) -> str:
        if x in rounded:
            for part, axis in (("weight", 1), ("bias", 0)):
                codes = [f"{name}_{part}_{kind}" for kind in ("codes", "scale", "zero")]
                add("DequantizeLinear", codes, f"{name}_{part}", axis=axis)
        linear = add("Gemm", [x, f"{name}_weight", f"{name}_bias"], f"{name}_linear")
        return activation(linear, name) if activated else linear

    def activation(x: str, name: str) -> str:
        if form.activation == "hard_swish":
            return add("HardSwish", [x], name)
        return add("Gelu", [x], name, approximate="none")

    def in_codes(x: str, wanted: bool = form.in_8_bits) -> str:
        if not wanted:
            return x
        steps = [f"{x}_scale", f"{x}_zero"]
        add("QuantizeLinear", [x, *steps], f"{x}_codes")
        rounded.add(add("DequantizeLinear", [f"{x}_codes", *steps], f"{x}_rounded"))
        return f"{x}_rounded"

    def harmonics() -> str:
        parts, below = [], "dirs"
        for order in range(1, form.sh_degree):
            if order > 1:
                # Columns are picked by a product with zeros and ones: exact, and much faster than Gather.
                below = add(
                    "Mul",
                    [add("MatMul", [source, f"sh_{order}_{kind}_pick"], f"sh_{order}_{kind}")
                     for kind, source in (("parent", below), ("axis", "dirs"))],
                    f"sh_{order}",
                )  # fmt: skip
            parts.append(below)
        if not parts:  # one band: the constant alone broadcasts over the pixels
            return "sh_bias"
        joined = add("Concat", parts, "sh_monomials", axis=1) if len(parts) > 1 else parts[0]
        return add("Gemm", [joined, "sh_weight", "sh_bias"], "sh")

    h = "features"
    for index in range(form.n_spatial):
        h = dense(f"spatial_{index}", h, activated=True)
    h = in_codes(h)
    f = dense("to_sh", h)
    e = add("Mul", [f, harmonics()], "sh_encoded")
    z = dense("directional_0_bottleneck", h)
    e = in_codes(e, form.rounds_encoded)
    if e in rounded:  # runtimes multiply codes only where no float32 sum is added
        codes = [f"directional_0_sh_weight_{kind}" for kind in ("codes", "scale", "zero")]
        weight = add("DequantizeLinear", codes, "directional_0_sh_weight", axis=1)
        z = add("Add", [z, add("Gemm", [e, weight], "directional_0_sh")], "directional_0_linear")
    else:
        z = add("Gemm", [e, "directional_0_sh_weight", z], "directional_0_linear")
    z = activation(z, "directional_0")
    for index in range(1, form.n_directional + 1):
        z = dense(f"directional_{index}", in_codes(z), activated=True)
    add("Sigmoid", [dense("output", z)], "rgb")
    return nodes


def head_ports(n_channels: int) -> tuple[list[Port], list[Port]]:
    """Return the inputs and outputs of a head's graph."""
    return [Port("features", n_channels), Port("dirs", 3)], [Port("rgb", 3)]


def read_head(data: bytes, where: str) -> HeadArrays:
    """Read the numbers of a head from an ONNX file.

    Args:
        data: the file's bytes.
        where: the name of the file for error messages.

    Raises:
        FormatError: the file holds anything but the graph of a head.
    """
    graph = read_graph(data, where)
    return _Reader(graph, where).head()


class _Reader:
    """Reader that takes the constants of a graph one by one, and checks that none is left."""

    def __init__(self, graph: Graph, where: str) -> None:
        self._graph, self._where = graph, where
        self._left = dict(graph.constants)

    def head(self) -> HeadArrays:
        form = self._form()
        first = self._left.get("spatial_0_weight", np.zeros(0))
        width = first.shape[0] if first.ndim == 2 else 0
        n_parameters = sum(constant.size for constant in self._left.values())
        if (self._graph.inputs, self._graph.outputs) != head_ports(width):
            raise self._wrong(
                "ports", f"features [n, {width}] and dirs [n, 3] to rgb [n, 3]",
                f"{_listed(self._graph.inputs)} to {_listed(self._graph.outputs)}",
            )  # fmt: skip
        roundings: list[Rounding] = []

        def rounding(name: str) -> Rounding | None:
            if form.in_8_bits:
                roundings.append(self._rounding(name))
            return roundings[-1] if form.in_8_bits else None

        spatial = []
        for index in range(form.n_spatial):
            spatial.append(self._layer(f"spatial_{index}", width))
            width = spatial[-1].weight.shape[1]
        of_h = rounding(f"spatial_{form.n_spatial - 1}")
        to_sh = self._layer("to_sh", width, rounding=of_h)
        n_encoded = to_sh.weight.shape[1]
        harmonics = self._harmonics(form.sh_degree, n_encoded)
        bottleneck = self._layer("directional_0_bottleneck", width, rounding=of_h)
        width = bottleneck.weight.shape[1]
        of_encoded = self._rounding("sh_encoded") if form.rounds_encoded else None
        from_sh = self._without_bias("directional_0_sh", n_encoded, width, of_encoded)
        directional = []
        for index in range(1, form.n_directional + 1):
            of_z = rounding(f"directional_{index - 1}")
            directional.append(self._layer(f"directional_{index}", width, rounding=of_z))
            width = directional[-1].weight.shape[1]
        output = self._layer("output", width, 3)
        if self._left:
            raise self._wrong("constants", "those of a head", f"{min(self._left)[:80]!a} as well")
        return HeadArrays(
            form, spatial, roundings, of_encoded, to_sh, harmonics, bottleneck, from_sh, directional, output,
            n_parameters,
        )  # fmt: skip

    def _form(self) -> HeadForm:
        """Infer the form from the names of the constants, and check that the nodes are those of that form."""
        graph, names = self._graph, self._left

        def count(name: str, first: int, most: int) -> int:
            return next(n for n in itertools.count() if n > most or name.format(first + n) not in names)

        n_spatial = count("spatial_{}_bias", 0, MAX_LAYERS)
        in_8_bits = f"spatial_{n_spatial - 1}_scale" in names
        n_directional = count("directional_{}_bias" + "_codes" * in_8_bits, 1, MAX_LAYERS)
        n_orders = count("sh_{}_axis_pick", 2, MAX_DEGREE)
        sh_degree = n_orders + 2 if "sh_weight" in names else 1
        is_hard = any(node.operator == "HardSwish" for node in graph.nodes)
        activation: Activation = "hard_swish" if is_hard else "gelu"
        rounds_encoded = "sh_encoded_scale" in names
        form = HeadForm(n_spatial, n_directional, sh_degree, in_8_bits, activation, rounds_encoded)
        known = 1 <= n_spatial <= MAX_LAYERS and n_directional <= MAX_LAYERS and sh_degree <= MAX_DEGREE
        if not known or graph.nodes != head_nodes(form):
            raise self._wrong("nodes", "the graph of a head", "another one")
        if (graph.opset, graph.ir_version) != (OPSET, IR_VERSION):
            got = f"{graph.opset} and {graph.ir_version}"
            raise self._wrong("versions", f"operators {OPSET} and IR {IR_VERSION}", got)
        return form

    def _take(self, name: str, kind: type, *shape: int | None) -> np.ndarray:
        """Take a constant, and check its type and shape; None in `shape` allows any width."""
        array = self._left.pop(name, None)
        if array is None:
            raise self._wrong(name, "this constant", "none")
        fits = array.ndim == len(shape) and all(
            0 < n <= MAX_WIDTH and (wanted is None or n == wanted)
            for n, wanted in zip(array.shape, shape, strict=True)
        )
        if array.dtype != kind or not fits:
            axes = ["n" if n is None else n for n in shape]
            expected = f"{np.dtype(kind).name} [{', '.join(map(str, axes))}]"
            raise self._wrong(name, expected, f"{array.dtype.name} {list(array.shape)}")
        return array

    def _floats(self, name: str, *shape: int | None) -> np.ndarray:
        array = self._take(name, np.float32, *shape)
        if not np.isfinite(array).all():
            raise self._wrong(name, "finite numbers", "NaN or infinity")
        return array

    def _layer(
        self, name: str, n_in: int, n_out: int | None = None, rounding: Rounding | None = None
    ) -> Layer:
        if rounding is None:
            weight = self._floats(f"{name}_weight", n_in, n_out)
            return Layer(weight, self._floats(f"{name}_bias", weight.shape[1]))
        weight, product = self._codes(name, n_in, n_out, rounding)
        width = weight.shape[1]
        bias = self._take(f"{name}_bias_codes", np.int32, width)
        scale = self._scales(f"{name}_bias_scale", width)
        self._zeros(f"{name}_bias_zero", np.int32, width)
        if not np.array_equal(product, scale):
            raise self._wrong(f"{name}_bias_scale", "the scale of the products", "another one")
        return self._fitting(name, Layer(weight, bias, scale))

    def _without_bias(self, name: str, n_in: int, n_out: int, rounding: Rounding | None) -> Layer:
        if rounding is None:
            return Layer(self._floats(f"{name}_weight", n_in, n_out), np.zeros(n_out, np.float32))
        weight, scale = self._codes(name, n_in, n_out, rounding)
        if not np.isfinite(scale).all():
            raise self._wrong(f"{name}_weight_scale", "products with a finite scale", "others")
        return self._fitting(name, Layer(weight, np.zeros(n_out, np.int32), scale))

    def _codes(
        self, name: str, n_in: int, n_out: int | None, rounding: Rounding
    ) -> tuple[np.ndarray, np.ndarray]:
        """Take the codes of a layer's weights, and the scale of their products with input codes."""
        weight = self._take(f"{name}_weight_codes", np.int8, n_in, n_out)
        scale = self._scales(f"{name}_weight_scale", weight.shape[1])
        self._zeros(f"{name}_weight_zero", np.int8, weight.shape[1])
        with np.errstate(over="ignore"):
            return weight, scale * rounding.scale

    def _zeros(self, name: str, kind: type, width: int) -> None:
        if self._take(name, kind, width).any():
            raise self._wrong(name, "zeros", "others")

    def _fitting(self, name: str, layer: Layer) -> Layer:
        """Return the layer if its sums of products fit into 32 bits, else raise FormatError."""
        codes = np.abs(layer.weight.astype(np.int64)).sum(axis=0)
        if (np.abs(layer.bias.astype(np.int64)) + 255 * codes > LARGEST_SUM).any():
            raise self._wrong(name, "sums of products that fit into 32 bits", "larger ones")
        return layer

    def _scales(self, name: str, *shape: int) -> np.ndarray:
        array = self._floats(name, *shape)
        if not (array > 0).all():
            raise self._wrong(name, "numbers above 0", "others")
        return array

    def _rounding(self, name: str) -> Rounding:
        scale = self._scales(f"{name}_scale", 1)
        zero = self._take(f"{name}_zero", np.uint8, 1)
        return Rounding(scale[0], int(zero[0]))

    def _harmonics(self, sh_degree: int, n_encoded: int) -> Layer:
        n_monomials = 3
        for order in range(2, sh_degree):
            _, parents, axes = monomials(order)
            n_below = order * (order + 1) // 2
            for kind, width, index in (("parent", n_below, parents), ("axis", 3, axes)):
                pick = self._take(f"sh_{order}_{kind}_pick", np.float32, width, len(index))
                if not np.array_equal(pick, np.eye(width)[:, index]):
                    raise self._wrong(f"sh_{order}_{kind}_pick", "the columns of a monomial", "others")
            n_monomials += len(parents)
        bias = self._floats("sh_bias", n_encoded)
        if sh_degree == 1:
            return Layer(np.zeros((0, n_encoded), np.float32), bias)
        return Layer(self._floats("sh_weight", n_monomials, n_encoded), bias)

    def _wrong(self, what: str, expected: str, got: str) -> FormatError:
        return FormatError(f"{self._where}: {what}: expected {expected}, got {got}")


def _listed(ports: list[Port]) -> str:
    shown = ", ".join(f"{ascii(port.name[:40])[1:-1]} [n, {port.width}]" for port in ports[:4])
    return shown or "nothing"
