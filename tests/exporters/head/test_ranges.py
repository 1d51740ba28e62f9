"""Tests of the 8-bit head: near the float head, independent of the batch, clipped at its ranges' ends."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnx
import onnxruntime
import pytest

from exporters.head.onnx_head import HeadWeights, head_onnx
from exporters.head.ranges import activation_ranges
from player.errors import ShapeError
from player.head.graph import read_head
from tests.numerics.bounds import Row
from tests.player.head.heads import play_in_integers
from tests.reference import ACTIVATIONS, spherical_harmonics

N_CHANNELS, WIDTH, N_SH = 12, 64, 4
EXTREME = Row(
    "The exported head", "head in 8 bits, against whole numbers", "features 4 and 1e4 times as large",
    0.01, "of rgb",
    "activations are clipped, never wrapped; one beside the border of two levels may cross it",
)  # fmt: skip
ROUNDED = Row(
    "The exported head", "what 8 bits cost, root mean square", "features as when measured",
    0.01, "of rgb",
)  # fmt: skip


def layer(random: np.random.Generator, n_in: int, n_out: int) -> tuple[np.ndarray, np.ndarray]:
    return random.normal(size=(n_in, n_out)) * (2 / n_in) ** 0.5, random.normal(size=n_out) * 0.1


@pytest.fixture(scope="module", params=["gelu", "hard_swish"])
def weights(request: pytest.FixtureRequest) -> HeadWeights:
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
        activation=request.param,
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
    ROUNDED.check(error)  # 256 levels in each of four layers
    assert error > 0, "not simply the same graph"


def test_a_pixel_does_not_depend_on_its_neighbours(weights: HeadWeights) -> None:
    seen = inputs(500, seed=3)
    head = session(weights, eight=True)
    (together,) = head.run(None, seen)
    for index in (0, 17, 499):
        (alone,) = head.run(None, {name: array[index : index + 1] for name, array in seen.items()})
        np.testing.assert_array_equal(np.asarray(together)[index], np.asarray(alone)[0])


Squeeze = Callable[[int, np.ndarray], np.ndarray]
"""Function (number, x) -> x applied to the inputs of 8-bit layers: h (0), e (1) and each z (2, 3)."""


def oracle(weights: HeadWeights, seen: dict[str, np.ndarray], squeeze: Squeeze) -> np.ndarray:
    """Evaluate the head in float64, without rounding, with `squeeze` applied to inputs of 8-bit layers."""
    activation = ACTIVATIONS[weights.activation]
    h = seen["features"].astype(np.float64)
    for weight, bias in weights.spatial:
        h = activation(h @ weight + bias)
    h = squeeze(0, h)
    basis = spherical_harmonics(seen["dirs"].astype(np.float64), weights.sh_degree)
    encoded = (h @ weights.to_sh[0] + weights.to_sh[1]) * np.repeat(basis, weights.n_sh_features, axis=1)
    encoded = squeeze(1, encoded)
    d_bottleneck, d_sh, bias = weights.directional_first
    z = activation(h @ d_bottleneck + encoded @ d_sh + bias)
    for number, (weight, bias) in enumerate(weights.directional, start=2):
        z = activation(squeeze(number, z) @ weight + bias)
    return 1 / (1 + np.exp(-(z @ weights.output[0] + weights.output[1])))


@pytest.mark.parametrize("size", [4.0, 1e4])
def test_extreme_features_are_clipped_not_wrapped(weights: HeadWeights, size: float) -> None:
    """Activations out of range are clipped. Wrapping around, as a cast to 8 bits does, would be far off."""
    seen = inputs(100, seed=4)
    seen["features"] *= size
    ranges = activation_ranges(weights, **inputs(4000))
    (rgb,) = session(weights, eight=True).run(None, seen)
    outside = []

    def clipped(number: int, x: np.ndarray) -> np.ndarray:
        low, high = ranges[number]
        outside.append(float(((x < low) | (x > high)).mean()))
        return np.clip(x, low, high)

    def wrapped(number: int, x: np.ndarray) -> np.ndarray:
        low, high = ranges[number]
        return low + (x - low) % (high - low)

    expected = play_in_integers(read_head(head_onnx(weights, ranges), "head"), seen["features"], seen["dirs"])
    error = np.asarray(rgb) - expected  # an activation near the border of two levels may cross it
    EXTREME.check(error)
    assert np.sqrt(np.mean(error**2)) < 5e-4
    assert np.sqrt(np.mean((rgb - oracle(weights, seen, clipped)) ** 2)) < 0.02, "what 8 bits round"
    assert outside[0] > 0.1, "there is something to clip"
    assert np.abs(oracle(weights, seen, wrapped) - oracle(weights, seen, clipped)).mean() > 0.05


def test_ranges_contain_zero_and_almost_everything(weights: HeadWeights) -> None:
    """Ranges contain zero and all but 0.4 to 5 in ten thousand activations of other inputs than those that
    they were measured on."""
    ranges = activation_ranges(weights, **inputs(4000))
    assert len(ranges) == 4
    found: dict[int, np.ndarray] = {}

    def kept(number: int, x: np.ndarray) -> np.ndarray:
        found[number] = x
        return x

    oracle(weights, inputs(4000, seed=5), kept)
    for number, (low, high) in enumerate(ranges):
        assert low <= 0 < high
        inside = ((found[number] >= low) & (found[number] <= high)).mean()
        assert 0.9995 < inside < 0.99996, "the rare largest ones would make every step coarser"
        assert high < found[number].max() and low > found[number].min() - 5e-4, "within the tanh form of GELU"


def test_weights_are_within_half_a_step_of_their_codes(weights: HeadWeights) -> None:
    """Weights are within half a quantization step of what is stored. A step of an output is 1/127 of the
    largest sum of two neighbouring weights' magnitudes."""
    model = onnx.load_from_string(head_onnx(weights, activation_ranges(weights, **inputs(4000))))
    constants = {entry.name: onnx.numpy_helper.to_array(entry) for entry in model.graph.initializer}
    wide = [weights.to_sh[0], *weights.directional_first[:2], *(weight for weight, _ in weights.directional)]
    met = set()
    for node in model.graph.node:
        codes = constants.get(node.input[0]) if node.op_type == "DequantizeLinear" else None
        if codes is None or codes.dtype != np.int8:
            continue
        stored, steps = codes * constants[node.input[1]].astype(np.float64), constants[node.input[1]]
        of_same_shape = [n for n, weight in enumerate(wide) if weight.shape == codes.shape]
        number = min(of_same_shape, key=lambda n: np.abs(stored - wide[n]).sum())
        met.add(number)
        assert (np.abs(stored - wide[number]) <= 0.5001 * steps).all()
        size = np.abs(wide[number])
        np.testing.assert_allclose(steps, (size[::2] + size[1::2]).max(axis=0) / 127, rtol=1e-6)
    assert met == set(range(len(wide)))


def test_one_range_for_each_activation(weights: HeadWeights) -> None:
    with pytest.raises(ShapeError, match="ranges: expected 4, got 1"):
        head_onnx(weights, [(0.0, 1.0)])
