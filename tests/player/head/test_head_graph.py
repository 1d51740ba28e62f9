"""Tests that heads other than our exporter writes are refused in one line, whatever would run them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from exporters.head.onnx_head import head_onnx
from exporters.head.ranges import activation_ranges
from player.errors import FormatError
from player.head.graph import PAIR_LIMIT, pair_sums, read_head
from player.head.head import Head
from tests.exporters.head.test_onnx_head import inputs, random_head
from tests.numerics.bounds import Row
from tests.player.head.heads import head_onnx_of_before, play_in_integers

N_CHANNELS = 8
PAIRS = Row(
    "The exported head", "sums of two products of codes, on processors that add them in 16 bits",
    "features as they come, and of 1e4", unit="the same picture as with wider sums, exactly",
    at_ends="neighbouring codes of weights add up to 128 at most;"
    " older heads are run with onnxruntime's wider products",
)  # fmt: skip
TOO_LARGE_SUMS = Row(
    "The exported head", "head whose sums of products may not fit into 32 bits", unit="refused",
    at_ends="when it is opened",
)  # fmt: skip
WEIGHTS = random_head(N_CHANNELS, 32)
RANGES = list(activation_ranges(WEIGHTS, *inputs(2000, N_CHANNELS)))
PLAIN, IN_8_BITS = head_onnx(WEIGHTS), head_onnx(WEIGHTS, RANGES)

Change = Callable[[onnx.ModelProto], object]


def refused(data: bytes, message: str) -> None:
    """Check that a head is refused in both ways to run it, in one line that names the file once."""
    for compiled in (False, True):
        with pytest.raises(FormatError, match=message) as caught:
            Head(data, N_CHANNELS, compiled)
        text = str(caught.value)
        assert "\n" not in text and len(text) < 400 and text.count("head.onnx") == 1


def node_of(model: onnx.ModelProto, output: str) -> onnx.NodeProto:
    return next(node for node in model.graph.node if node.output[0] == output)


def tensor_of(model: onnx.ModelProto, name: str) -> onnx.TensorProto:
    return next(tensor for tensor in model.graph.initializer if tensor.name == name)


def put(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Return a change that replaces the constant `name`."""

    def apply(model: onnx.ModelProto) -> None:
        tensor = tensor_of(model, name)
        tensor.CopyFrom(numpy_helper.from_array(change(numpy_helper.to_array(tensor).copy()), name))

    return apply


def renamed_output(old: str, new: str) -> Change:
    """Return a change that renames the output `old` of a node to `new`."""

    def apply(model: onnx.ModelProto) -> None:
        for node in model.graph.node:
            node.output[:] = [new if name == old else name for name in node.output]

    return apply


def with_node(*node: object, **attributes: object) -> Change:
    return lambda model: model.graph.node.append(helper.make_node(*node, **attributes))


def outside(model: onnx.ModelProto) -> None:
    """Change a model to say that some weights are in another file."""
    tensor = tensor_of(model, "output_weight")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "../secret"


def huge(model: onnx.ModelProto) -> None:
    tensor = tensor_of(model, "output_weight")
    tensor.dims[:], tensor.raw_data = [2**32, 2**32], b""


def swapped(model: onnx.ModelProto) -> None:
    nodes = list(model.graph.node)
    del model.graph.node[:]
    model.graph.node.extend([nodes[1], nodes[0], *nodes[2:]])


def first_input(dims: list[object], kind: int = TensorProto.FLOAT) -> Change:
    return lambda model: model.graph.input[0].CopyFrom(helper.make_tensor_value_info("features", kind, dims))


def to_nan(array: np.ndarray) -> np.ndarray:
    array.flat[0] = np.nan
    return array


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (renamed_output("to_sh_linear", "features"), "nodes: expected the graph of a head"),
        (renamed_output("spatial_0", "dirs"), "nodes: expected the graph of a head"),
        (renamed_output("rgb", "colour"), "nodes: expected the graph of a head"),
        (with_node("Loop", ["rgb", "", "dirs"], ["loop"], body=onnx.GraphProto()), "got field 6"),
        (with_node("Identity", ["rgb"], ["again"]), "nodes: expected the graph of a head"),
        (lambda model: setattr(node_of(model, "sh"), "domain", "com.example"), "got field 7"),
        (lambda model: node_of(model, "sh").output.append("more"), "expected nodes of one output"),
        (lambda model: model.functions.add(), "got field 25"),
        (lambda model: model.training_info.add(), "got field 20"),
        (lambda model: model.opset_import.add(domain="com.example", version=1), "one version of ONNX's"),
        (lambda model: setattr(model.opset_import[0], "version", 21), "versions: expected operators 20"),
        (lambda model: setattr(model, "ir_version", 8), "versions: expected operators 20 and IR 10"),
        (swapped, "nodes: expected the graph of a head"),
        (outside, "got field 13"),
        (huge, r"output_weight.*expected the bytes of float32 \[4294967296, 4294967296\], got 0 bytes"),
        (lambda model: model.graph.initializer.append(tensor_of(model, "sh_bias")), "sh_bias.*of this name"),
        (put("sh_bias", to_nan), "sh_bias: expected finite numbers, got NaN or infinity"),
        (put("output_weight", to_nan), "output_weight: expected finite numbers"),
        (put("output_weight", lambda a: a[:, :2]), r"output_weight: expected float32 \[32, 3\], got float32"),
        (put("output_bias", lambda a: np.zeros(0, np.float32)), "output_bias.*expected the bytes of"),
        (put("spatial_0_weight", np.transpose), r"ports: expected features \[n, 32\]"),
        (put("spatial_0_bias", lambda a: a[None]), r"spatial_0_bias: expected float32 \[32\], got float32"),
        (put("spatial_0_bias", lambda a: a.astype(np.float64)), "spatial_0_bias.*expected raw numbers"),
        (put("sh_2_axis_pick", lambda a: a[:, ::-1].copy()), "sh_2_axis_pick: expected the columns of"),
        (put("to_sh_weight", lambda a: np.zeros((32, 5000), np.float32)), r"to_sh_weight: .*got float32"),
        (lambda model: model.graph.initializer.pop(0), "expected this constant, got none|ports"),
        (lambda model: model.graph.initializer.append(numpy_helper.from_array(np.ones(9, np.float32), "x")),
         "constants: expected those of a head, got 'x' as well"),
        (first_input(["n", 5]), r"ports: expected features \[n, 8\].*got features \[n, 5\]"),
        (first_input([7, N_CHANNELS]), "'features': expected float"),
        (first_input(["n", N_CHANNELS], TensorProto.DOUBLE), "'features': expected float"),
        (lambda model: model.graph.output.append(model.graph.input[0]), "ports: expected"),
        (lambda model: node_of(model, "sh_monomials").attribute.add(name="axis", i=1, type=2), "one integer"),
        (lambda model: setattr(node_of(model, "sh_monomials").attribute[0], "i", 0), "nodes: expected the"),
    ],
)  # fmt: skip
def test_heads_that_are_not_ours(change: Change, message: str) -> None:
    model = onnx.load_from_string(PLAIN)
    change(model)
    refused(model.SerializeToString(), message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put("spatial_0_scale", np.zeros_like), "spatial_0_scale: expected numbers above 0"),
        (
            put("spatial_0_zero", lambda a: a.astype(np.int8)),
            r"spatial_0_zero: expected uint8 \[1\], got int8",
        ),
        (put("directional_1_weight_zero", np.ones_like), "directional_1_weight_zero: expected zeros"),
        (put("directional_1_bias_zero", np.ones_like), "directional_1_bias_zero: expected zeros"),
        (put("directional_1_bias_scale", lambda a: a * 2), "expected the scale of the products"),
        (put("directional_1_weight_scale", lambda a: -a), "weight_scale: expected numbers above 0"),
        (put("to_sh_weight_scale", lambda a: np.full_like(a, 3e38)), "expected the scale of the products"),
        (put("to_sh_weight_codes", lambda a: a.astype(np.uint8)), "to_sh_weight_codes: expected int8"),
        (put("to_sh_bias_codes", lambda a: np.full_like(a, 2**31 - 1)), "expected sums of products that fit"),
        (put("to_sh_bias_codes", lambda a: np.full_like(a, -(2**31))), "expected sums of products that fit"),
        (lambda model: setattr(node_of(model, "to_sh_weight").attribute[0], "i", 0), "nodes: expected the"),
    ],
)
def test_heads_in_8_bits_that_are_not_ours(change: Change, message: str) -> None:
    model = onnx.load_from_string(IN_8_BITS)
    change(model)
    refused(model.SerializeToString(), message)
    if "sums of products" in message:
        TOO_LARGE_SUMS.holds()


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def rewritten(data: bytes, path: tuple[int, ...], change: Callable[[bytes], bytes]) -> bytes:
    """Return `data` with `change` applied to a nested field; `path` has field numbers, outermost first."""
    if not path:
        return change(data)
    at = 0
    while at < len(data):
        start, key = at, data[at]  # every field of these files has a number below 16
        size, shift, at = 0, 0, at + 1
        while True:
            size |= (data[at] & 127) << shift
            shift, at = shift + 7, at + 1
            if data[at - 1] < 128:
                break
        if key == path[0] << 3 | 2:
            inner = rewritten(data[at : at + size], path[1:], change)
            return data[:start] + bytes([key]) + varint(len(inner)) + inner + data[at + size :]
        at += size if key & 7 == 2 else 0
    raise AssertionError(path)


@pytest.mark.parametrize(
    ("path", "more", "message"),
    [
        ((7, 1), b"\x22\x04Loop", "expected op_type once, got it again"),
        ((7, 1), b"\x1a\x01x", "expected name once, got it again"),
        ((7, 5), b"\x10\x01", "expected data_type once, got it again"),
        ((7, 5), b"\x4a\x00", "expected raw_data once, got it again"),
        ((7, 11), b"\x12\x00", "expected type once, got it again"),
        ((), b"\x3a\x00", "expected graph once, got it again"),
        ((), b"\x08\x0a", "expected ir_version once, got it again"),
        ((7,), b"\x08\x01", "got node of wire type 0"),
        ((7, 5), b"\x0a\x01\x01", "got dims of wire type 2"),
        ((7, 1), b"\x0a\x02\xff\xfe", "expected names in UTF-8"),
        ((7, 5), b"\x08" + b"\xff" * 9 + b"\x02", "an integer of more than 64 bits"),
        ((7, 1), b"\x0a\x7f", "got one cut short"),
        ((7, 1), b"\x0a\x83" + b"\x80" * 8 + b"\x00dirs", "an integer longer than it has to be"),
        ((), b"\x3b", "got graph of wire type 3"),
    ],
)
def test_messages_that_can_be_read_in_two_ways(path: tuple[int, ...], more: bytes, message: str) -> None:
    """Ambiguous messages are refused. onnxruntime loads some of them: of two values it takes the last one."""
    assert rewritten(PLAIN, path, lambda content: content) == PLAIN
    refused(rewritten(PLAIN, path, lambda content: content + more), message)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected an ONNX graph"),
        (b"#!/bin/sh\n", "expected an ONNX graph"),
        (b"\xff" * 300_000, "an integer of more than 64 bits"),
        (PLAIN[:-40], "got one cut short"),
        (b"\x3a" + varint(40_000) + b"\x0a\x00" * 20_000, "expected at most 10000 fields in a head"),
        (head_onnx(random_head(9, 32)), r"features: expected float \[n, 8\], got \[n, 9\]"),
    ],
    ids=["empty", "script", "noise", "cut", "nodes", "9 channels"],
)
def test_files_that_are_no_head(data: bytes, message: str) -> None:
    refused(data, message)


def test_a_head_that_no_player_takes_is_not_written() -> None:
    with pytest.raises(FormatError, match="head: nodes: expected the graph of a head"):
        head_onnx(random_head(n_more=20))


@pytest.mark.parametrize("width", [32, 33, 64])
@pytest.mark.parametrize("size", [1.0, 1e4])
def test_a_processor_that_adds_pairs_in_16_bits_shows_the_same(width: int, size: float) -> None:
    """Adding pairs of products in 16 bits gives the same picture, also where features are huge, so that codes
    of 255 meet the largest weights."""
    weights = random_head(N_CHANNELS, width)
    features, dirs = inputs(500, N_CHANNELS)
    ranges = list(activation_ranges(weights, *inputs(2000, N_CHANNELS)))
    features = features * np.float32(size)
    head, before = (read_head(data(weights, ranges), "head") for data in (head_onnx, head_onnx_of_before))
    assert before.may_saturate and not head.may_saturate
    exact, there = (play_in_integers(head, features, dirs, kind) for kind in (False, True))
    PAIRS.holds(np.array_equal(exact, there))
    if size > 1:  # older heads show the error that is avoided
        exact, there = (play_in_integers(before, features, dirs, kind) for kind in (False, True))
        assert np.abs(exact - there).max() > 0.02


def test_every_pair_of_codes_is_bounded_and_one_reaches_the_bound() -> None:
    random = np.random.default_rng(0)
    for _ in range(200):
        weight = random.normal(size=(random.integers(1, 9), 3)) * 10.0 ** random.integers(-9, 9)
        weights = random_head(N_CHANNELS, len(weight), n_more=0)
        bottleneck = np.resize(weight, weights.directional_first[0].shape)
        _, from_sh, bias = weights.directional_first
        weights = replace(weights, directional_first=(bottleneck, from_sh, bias * 0))
        codes = read_head(head_onnx(weights, [(-0.2, 1.0)] * 2), "head").bottleneck.weight
        sums = pair_sums(codes).max(axis=0)
        assert (sums <= PAIR_LIMIT).all() and (sums >= PAIR_LIMIT - 2).all()


@pytest.mark.parametrize(("data", "entry"), [(head_onnx_of_before, "1"), (head_onnx, "")])
def test_onnxruntime_is_asked_for_exact_products_of_older_heads(
    data: Callable[..., bytes], entry: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[onnxruntime.SessionOptions] = []
    start = onnxruntime.InferenceSession

    def session(data: bytes, options: onnxruntime.SessionOptions, **more: object) -> object:
        asked.append(options)
        return start(data, options, **more)

    monkeypatch.setattr(onnxruntime, "InferenceSession", session)
    Head(data(WEIGHTS, RANGES), N_CHANNELS)
    if entry:
        assert asked[0].get_session_config_entry("session.x64quantprecision") == entry
    else:
        with pytest.raises(RuntimeError, match="x64quantprecision"):
            asked[0].get_session_config_entry("session.x64quantprecision")
