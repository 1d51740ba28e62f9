"""Tests of the ONNX head, run by onnxruntime, against the float64 oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest

from exporters.head.onnx_head import HeadWeights, head_onnx
from player.errors import FormatError, ShapeError
from player.head.graph import Activation
from tests.reference import evaluate_head


def random_head(
    n_channels: int = 8,
    width: int = 32,
    sh_degree: int = 4,
    n_sh_features: int = 4,
    n_spatial: int = 1,
    n_more: int = 2,
    activation: Activation = "gelu",
) -> HeadWeights:
    random = np.random.default_rng(5)

    def layer(n_in: int, n_out: int) -> tuple[np.ndarray, np.ndarray]:
        return (
            random.normal(scale=np.sqrt(2 / n_in), size=(n_in, n_out)).astype(np.float32),
            random.normal(scale=0.1, size=n_out).astype(np.float32),
        )

    n_encoded = sh_degree**2 * n_sh_features
    spatial = tuple(layer(n_channels if index == 0 else width, width) for index in range(n_spatial))
    first = (layer(width, width)[0], layer(n_encoded, width)[0], layer(1, width)[1])
    more = tuple(layer(width, width) for _ in range(n_more))
    return HeadWeights(
        spatial, layer(width, n_encoded), first, more, layer(width, 3), sh_degree, n_sh_features, activation
    )


def run(weights: HeadWeights, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(head_onnx(weights), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(["rgb"], {"features": features, "dirs": dirs})[0])


def inputs(n: int, n_channels: int = 8) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(n)
    dirs = random.normal(size=(n, 3))
    dirs[:6] = np.concatenate([np.eye(3), -np.eye(3)])[:n]
    dirs /= np.linalg.norm(dirs, axis=-1, keepdims=True)
    return random.normal(size=(n, n_channels)).astype(np.float32), dirs.astype(np.float32)


@pytest.mark.parametrize("activation", ["gelu", "hard_swish"])
@pytest.mark.parametrize("n", [0, 1, 500])
def test_any_number_of_pixels(n: int, activation: Activation) -> None:
    weights, (features, dirs) = random_head(activation=activation), inputs(n)
    rgb = run(weights, features, dirs)
    assert rgb.shape == (n, 3) and rgb.dtype == np.float32
    np.testing.assert_allclose(rgb, evaluate_head(weights, features, dirs), rtol=0, atol=1e-5)


@pytest.mark.parametrize("sh_degree", [1, 2, 3, 4, 5, 8])
@pytest.mark.parametrize(("n_sh_features", "n_spatial", "n_more"), [(1, 2, 0), (4, 1, 3)])
def test_any_shape_of_head(sh_degree: int, n_sh_features: int, n_spatial: int, n_more: int) -> None:
    weights = random_head(5, 16, sh_degree, n_sh_features, n_spatial, n_more)
    features, dirs = inputs(100, 5)
    np.testing.assert_allclose(
        run(weights, features, dirs), evaluate_head(weights, features, dirs), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("value", [0.0, 1e4, -1e4, 1e-40])
def test_extreme_constant_features(value: float) -> None:
    weights, (_, dirs) = random_head(), inputs(200)
    features = np.full((200, 8), value, np.float32)
    np.testing.assert_allclose(
        run(weights, features, dirs), evaluate_head(weights, features, dirs), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("scale", [1e4, 1e30, np.inf])
def test_extreme_random_features(scale: float) -> None:
    """Huge features give finite colours, as exact as float32 allows.

    Near a grey pixel, logits in the thousands cancel: float32 rounds by 2^-24 of the largest, and the
    sigmoid's slope is a quarter.
    """
    weights, (features, dirs) = random_head(), inputs(200)
    if not np.isfinite(scale):
        features = np.sign(features) * np.float32(3e38)
        rgb = run(weights, features, dirs)
        assert rgb.shape == (200, 3)  # beyond float32: NaN is acceptable, a crash is not
        return
    rgb = run(weights, (features * np.float32(scale)), dirs)
    assert np.isfinite(rgb).all() and rgb.min() >= 0 and rgb.max() <= 1
    if scale == 1e4:
        expected = evaluate_head(weights, features * np.float32(scale), dirs)
        np.testing.assert_allclose(rgb, expected, rtol=0, atol=0.25 * 1e4 * 10 * 2**-24)


def test_model_is_valid_and_reproducible() -> None:
    data = head_onnx(random_head())
    assert data == head_onnx(random_head())
    model = onnx.load_from_string(data)
    onnx.checker.check_model(model, full_check=True)
    assert [entry.version for entry in model.opset_import] == [20] and model.ir_version == 10
    assert [value.name for value in model.graph.input] == ["features", "dirs"]
    assert [value.name for value in model.graph.output] == ["rgb"]


def test_float64_weights_are_stored_as_float32() -> None:
    weights = random_head()
    double = replace(weights, output=tuple(array.astype(np.float64) for array in weights.output))  # type: ignore[arg-type]
    assert head_onnx(double) == head_onnx(weights)


def test_layers_that_do_not_fit() -> None:
    weights = random_head()
    with pytest.raises(ShapeError, match=r"head: output: expected \[32, 3\] and \[3\], got \(32, 4\)"):
        replace(weights, output=(np.zeros((32, 4), np.float32), np.zeros(3, np.float32)))
    with pytest.raises(ShapeError, match="head: to_sh"):
        replace(weights, sh_degree=3)
    with pytest.raises(ShapeError, match="head: spatial: expected at least one"):
        replace(weights, spatial=())
    with pytest.raises(FormatError, match="head: output: expected finite"):
        replace(weights, output=(weights.output[0] * np.nan, weights.output[1]))
