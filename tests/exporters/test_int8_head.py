"""The head in 8 bits: near the float head, independent of the batch, right at the ends of its ranges."""

from __future__ import annotations

import numpy as np
import onnxruntime
import pytest

from exporters.int8_head import activation_ranges
from exporters.onnx_head import HeadWeights, head_onnx
from player.errors import ShapeError

N_CHANNELS, WIDTH, N_SH = 12, 64, 4


def layer(random: np.random.Generator, n_in: int, n_out: int) -> tuple[np.ndarray, np.ndarray]:
    return random.normal(size=(n_in, n_out)) * (2 / n_in) ** 0.5, random.normal(size=n_out) * 0.1


@pytest.fixture(scope="module")
def weights() -> HeadWeights:
    random = np.random.default_rng(0)
    first = layer(random, WIDTH, WIDTH)
    return HeadWeights(
        spatial=(layer(random, N_CHANNELS, WIDTH),),
        to_sh=layer(random, WIDTH, 16 * N_SH),
        directional_first=(first[0], layer(random, 16 * N_SH, WIDTH)[0], first[1]),
        directional=(layer(random, WIDTH, WIDTH), layer(random, WIDTH, WIDTH)),
        output=layer(random, WIDTH, 3),
        sh_degree=4,
        n_sh_features=N_SH,
    )


def inputs(n: int, seed: int = 1) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    dirs = random.normal(size=(n, 3))
    dirs /= np.linalg.norm(dirs, axis=-1, keepdims=True)
    features = random.normal(size=(n, N_CHANNELS))
    return {"features": features.astype(np.float32), "dirs": dirs.astype(np.float32)}


def session(weights: HeadWeights, eight: bool) -> onnxruntime.InferenceSession:
    ranges = activation_ranges(weights, **inputs(4000)) if eight else None
    return onnxruntime.InferenceSession(head_onnx(weights, ranges), providers=["CPUExecutionProvider"])


def test_eight_bits_stay_near_float(weights: HeadWeights) -> None:
    seen = inputs(3000, seed=2)
    (exact,) = session(weights, eight=False).run(None, seen)
    (rounded,) = session(weights, eight=True).run(None, seen)
    error = float(np.sqrt(np.mean((np.asarray(exact) - np.asarray(rounded)) ** 2)))
    assert 0 < error < 0.01, "256 levels in each of four layers, and not simply the same graph"


def test_a_pixel_does_not_depend_on_its_neighbours(weights: HeadWeights) -> None:
    seen = inputs(500, seed=3)
    head = session(weights, eight=True)
    (together,) = head.run(None, seen)
    for index in (0, 17, 499):
        (alone,) = head.run(None, {name: array[index : index + 1] for name, array in seen.items()})
        np.testing.assert_array_equal(np.asarray(together)[index], np.asarray(alone)[0])


def test_extreme_features_are_clipped_not_wrapped(weights: HeadWeights) -> None:
    seen = inputs(100, seed=4)
    seen["features"] *= 1e4
    (rgb,) = session(weights, eight=True).run(None, seen)
    assert np.isfinite(np.asarray(rgb)).all()
    assert np.asarray(rgb).min() >= 0 and np.asarray(rgb).max() <= 1


def test_ranges_contain_zero_and_almost_everything(weights: HeadWeights) -> None:
    ranges = activation_ranges(weights, **inputs(4000))
    assert len(ranges) == 3
    for low, high in ranges:
        assert -0.18 < low <= 0 < high


def test_one_range_for_each_activation(weights: HeadWeights) -> None:
    with pytest.raises(ShapeError, match="ranges: expected 3, got 1"):
        head_onnx(weights, [(0.0, 1.0)])
