"""The compiled head against the float64 oracle, and what is left to onnxruntime."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from exporters.onnx_head import HeadWeights, head_onnx
from player.errors import FormatError
from player.head import CHUNK, Head
from player.head_compiled import BLOCK, HeadProgram
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
    assert isinstance(head._run, HeadProgram)
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


def test_other_graphs_are_left_to_onnxruntime(tmp_path: Path) -> None:
    eight_bits = head_onnx(random_head(), [(-1.0, 1.0)] * 3)
    one_band = head_onnx(replace(random_head(sh_degree=1), sh_degree=1))
    for data, n_channels in ((head_bytes(), 4), (eight_bits, 8), (one_band, 8)):
        head = open_head(tmp_path, data, n_channels)
        assert not isinstance(head._run, HeadProgram)
        assert head(*inputs(9, n_channels)).shape == (9, 3)
