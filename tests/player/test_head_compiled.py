"""The compiled head against the float64 oracle, and what is left to onnxruntime."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from exporters.int8_head import activation_ranges
from exporters.onnx_head import HeadWeights, head_onnx
from player.dense_tiles import MULTIPLIES_BYTES
from player.errors import FormatError
from player.head import CHUNK, Head
from player.head_compiled import CompiledHead
from player.head_program import BLOCK, DENSE_BYTES, ROUND, NotOursError, program_of
from player.onnx_graph import read_graph
from tests.exporters.test_onnx_head import inputs, random_head
from tests.player.conftest import head_bytes
from tests.reference import evaluate_head

# onnxruntime is held to 1e-5 against the same oracle; measured 2e-6, sums of float32 in another order.
TOLERANCE = 5e-6


def open_head(folder: Path, data: bytes, n_channels: int) -> Head:
    path = folder / "head.onnx"
    path.write_bytes(data)
    return Head(path, n_channels, compiled=True)


@pytest.mark.parametrize(
    "weights",
    [
        random_head(),
        random_head(n_channels=10, width=64, n_spatial=2, n_more=3),
        random_head(n_channels=3, width=17, sh_degree=2, n_sh_features=2, n_more=0),
        random_head(n_channels=33, width=40, sh_degree=3, n_sh_features=5),
    ],
    ids=["32", "64", "17", "40"],
)
def test_compiled_head_is_the_formula_in_any_number_of_pixels(weights: HeadWeights, tmp_path: Path) -> None:
    head = open_head(tmp_path, head_onnx(weights), weights.n_channels)
    assert isinstance(head._run, CompiledHead)
    for n in (0, 1, BLOCK - 1, BLOCK + 1, CHUNK + 5):
        features, dirs = inputs(n, weights.n_channels)
        rgb = head(features, dirs)
        assert rgb.shape == (n, 3) and rgb.dtype == np.float32
        np.testing.assert_allclose(rgb, evaluate_head(weights, features, dirs), rtol=0, atol=TOLERANCE)


def test_a_pixel_does_not_depend_on_the_others(tmp_path: Path) -> None:
    head = open_head(tmp_path, head_onnx(random_head()), 8)
    features, dirs = inputs(200)
    whole = head(features, dirs)
    parts = [head(features[i : i + 7], dirs[i : i + 7]) for i in range(0, 200, 7)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()


@pytest.mark.parametrize("size", [1e-30, 30.0])
def test_compiled_head_of_hard_features(size: float, tmp_path: Path) -> None:
    """Nothing at all, and beyond the range of erf; sums of large numbers are rounded more coarsely."""
    weights = random_head()
    head = open_head(tmp_path, head_onnx(weights), 8)
    features, dirs = inputs(100)
    features *= np.float32(size)
    expected = evaluate_head(weights, features, dirs)
    np.testing.assert_allclose(head(features, dirs), expected, rtol=0, atol=TOLERANCE * max(size, 1))


def test_compiled_head_beyond_the_range_of_exp(tmp_path: Path) -> None:
    features, dirs = inputs(100)
    rgb = open_head(tmp_path, head_onnx(random_head()), 8)(features * np.float32(1e6), dirs)
    assert np.isin(rgb.round(6), [0, 1]).mean() > 0.9 and rgb.min() >= 0 and rgb.max() <= 1


def test_what_is_no_number_is_told(tmp_path: Path) -> None:
    head = open_head(tmp_path, head_onnx(random_head()), 8)
    features, dirs = inputs(100)
    features[50, 3] = np.nan
    with pytest.raises(FormatError, match="expected 100 finite colours, got NaN"):
        head(features, dirs)


@pytest.mark.parametrize("width", [64, 40])
@pytest.mark.parametrize("in_bytes", [MULTIPLIES_BYTES, False], ids=["bytes", "floats"])
def test_compiled_head_in_8_bits_is_onnxruntimes(width: int, in_bytes: bool, tmp_path: Path) -> None:
    """But for a sum beside the border of two levels, which another order of additions takes across it."""
    weights = random_head(n_channels=8, width=width, n_more=2, sh_degree=4)
    seen = inputs(2000)
    data = head_onnx(weights, activation_ranges(weights, *seen))
    head, program = open_head(tmp_path, data, 8), program_of(read_graph(data), 8, in_bytes)
    assert isinstance(head._run, CompiledHead)
    kinds = {int(step[0]) for step in program.steps}
    assert (DENSE_BYTES in kinds) == in_bytes and (ROUND in kinds) != in_bytes
    for n in (0, 1, BLOCK - 1, 2000):
        features, dirs = (column[:n] for column in seen)
        expected = Head(tmp_path / "head.onnx", 8)(features, dirs)
        difference = np.abs(CompiledHead(program)(features, dirs) - expected)
        assert difference.shape == (n, 3)
        if n == 2000:
            assert np.sqrt((difference**2).mean()) < 2e-4 and difference.max() < 0.02
            assert (difference < TOLERANCE).mean() > 0.9


def test_products_of_bytes_are_exact(tmp_path: Path) -> None:
    """255 * 127 four times over does not fit into 16 bits, which some processors add pairs of products in."""
    weights = random_head(n_channels=8, width=64, n_more=1, sh_degree=4)
    large = tuple((np.full_like(w, 0.5) * np.sign(w), b) for w, b in weights.directional)
    weights = replace(weights, directional=large)
    features, dirs = inputs(300)
    data = head_onnx(weights, [(0.0, 1e-3)] * 2)  # every activation is clipped at code 255, or is 0
    in_bytes, in_floats = (
        CompiledHead(program_of(read_graph(data), 8, kind))(features * 50, dirs)
        for kind in (MULTIPLIES_BYTES, False)
    )
    np.testing.assert_allclose(in_bytes, in_floats, rtol=0, atol=TOLERANCE)


def test_other_graphs_are_left_to_onnxruntime(tmp_path: Path) -> None:
    one_band = head_onnx(replace(random_head(sh_degree=1), sh_degree=1))
    for data, n_channels in ((head_bytes(), 4), (one_band, 8)):
        head = open_head(tmp_path, data, n_channels)
        assert not isinstance(head._run, CompiledHead)
        assert head(*inputs(9, n_channels)).shape == (9, 3)


@pytest.mark.parametrize("change", ["zero", "scale", "axis", "bias", "large"])
def test_other_ways_to_write_8_bits_are_left_to_onnxruntime(change: str) -> None:
    """Codes of weights around another zero, a bias in other steps, sums that may not fit into 32 bits."""
    weights = random_head(n_channels=8, width=64, n_more=1, sh_degree=4)
    graph = read_graph(head_onnx(weights, [(-0.2, 1.0)] * 2))
    assert program_of(graph, 8) is not None
    constants, nodes = dict(graph.constants), list(graph.nodes)
    if change == "zero":
        constants["directional_1_weight_zero"] = np.ones(64, np.int8)
    elif change == "scale":
        constants["directional_1_bias_scale"] = constants["directional_1_bias_scale"] * np.float32(2)
    elif change == "axis":
        at = next(i for i, n in enumerate(nodes) if n.outputs == ["directional_1_weight"])
        nodes[at] = replace(nodes[at], attributes={"axis": 0})
    elif change == "bias":
        constants["directional_1_bias_codes"] = constants["directional_1_bias_codes"][:1]
    else:
        constants["directional_1_bias_codes"] = np.full(64, 2**31 - 1, np.int32)
    with pytest.raises(NotOursError):
        program_of(replace(graph, nodes=nodes, constants=constants), 8)
