"""`vfr-export out/ head.onnx` compared with torch on random and extreme inputs, in float32 and in 8 bits.

The float head is compared with the trained module in float64, the 8-bit head with torch's own fake
quantisation of the same layers.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch.nn.functional import gelu, hardswish

from exporters.head.asset_head import comparisons, head_bytes
from exporters.head.onnx_head import HeadWeights, Range, head_onnx, weight_scales
from exporters.head.ranges import activation_ranges
from player.asset.asset import Asset
from tests.exporters.formats import block
from tests.exporters.head.test_asset_head import with_head
from tests.numerics.bounds import Row
from vfr_bake.baking.head import fold_head
from vfr_bake.config import FieldConfig
from vfr_bake.field.networks import HeadNetwork, SphericalHarmonics

EXPORTED = "The exported head"
FLOAT32 = Row(
    EXPORTED, "layers in float32, against the trained module in float64",
    "random features, codes at their ends, 1e4 and 1e30; a head of 256 x 6 layers", 2e-6,
    "of rgb for each unit of the largest feature, from 1 to 200", "no pixel, one pixel",
)  # fmt: skip
INT8 = Row(
    EXPORTED, "layers in 8 bits, against torch's fake quantisation of them",
    "random features, codes at their ends, 1e4 and 1e30", 5e-3, "of rgb",
    "an activation in the middle of two levels may go either way",
)  # fmt: skip
INT8_COST = Row(
    EXPORTED, "what 8 bits cost this head, root mean square", "features as when measured",
    0.01, "of rgb", "beyond, activations are clipped",
)  # fmt: skip

N_CHANNELS = 16
SCALE = 0.02
"""Step of the codes, which is folded into the first layer as in a bake."""


@pytest.fixture(scope="module")
def head() -> HeadNetwork:
    torch.manual_seed(5)
    return HeadNetwork(FieldConfig(n_levels=N_CHANNELS // 2)).double()


@pytest.fixture(scope="module")
def weights(head: HeadNetwork) -> HeadWeights:
    return fold_head(head, head.first_weights() * SCALE)


@pytest.fixture(scope="module")
def asset(weights: HeadWeights, tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """A complete asset with as many channels as the head has; only its head is used."""
    opened = Asset.open(block.write_block(tmp_path_factory.mktemp("head") / "asset"))
    manifest = dataclasses.replace(opened.manifest, n_channels=N_CHANNELS)
    return dataclasses.replace(opened, manifest=manifest)


def exported(asset: Asset, folder: Path, data: bytes, decode: bool) -> onnxruntime.InferenceSession:
    written = head_bytes(with_head(asset, folder / "asset", data), decode)
    onnx.checker.check_model(onnx.load_from_string(written), full_check=True)
    return onnxruntime.InferenceSession(written, providers=["CPUExecutionProvider"])


def answers(session: onnxruntime.InferenceSession) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Return label, features, dirs and the file's rgb for every input that it takes."""
    found = []
    names = {port.name for port in session.get_inputs()}
    for label, features, codes, k_weights, dirs in comparisons(N_CHANNELS):
        if "codes" in names and codes is None:
            continue
        inputs = {"features": features, "codes": codes, "weights": k_weights, "dirs": dirs}
        (rgb,) = session.run(["rgb"], {name: inputs[name] for name in names})
        found.append((label, features, dirs, np.asarray(rgb)))
    return found


@pytest.mark.parametrize("decode", [False, True], ids=["head", "decode and head"])
def test_float32_is_the_trained_head(
    decode: bool, head: HeadNetwork, weights: HeadWeights, asset: Asset, tmp_path: Path
) -> None:
    """The exported float32 head is the trained one within 2e-6: sums of 256 float32 products, of which a
    quarter passes the sigmoid. If features are so large that logits of hundreds cancel, 2^-24 of the largest
    activation remains; beyond that the sigmoid is 0 or 1."""
    labels = set()
    for label, features, dirs, rgb in answers(exported(asset, tmp_path, head_onnx(weights), decode)):
        with torch.no_grad():
            x = torch.from_numpy(features.astype(np.float64) * SCALE)
            expected = head(x, torch.from_numpy(dirs.astype(np.float64))).numpy()
        assert rgb.shape == expected.shape == (len(features), 3), label
        size = float(np.abs(features).max(initial=0)) * SCALE
        FLOAT32.check(rgb, expected, of=min(max(size, 1), 200))
        labels.add(label)
    assert {"no pixel", "one pixel", "random", "lowest codes", "highest codes"} <= labels
    assert decode or {"subnormal", "ten thousand", "1e30"} <= labels


@pytest.mark.parametrize("decode", [False, True], ids=["head", "decode and head"])
def test_int8_is_torch_s_quantisation(
    decode: bool, head: HeadNetwork, weights: HeadWeights, asset: Asset, tmp_path: Path
) -> None:
    """The exported 8-bit head is torch's quantisation within 5e-3: an activation in the middle of two levels
    may go either way, which moves a colour by a level of one of 256 activations, and there may be two or
    three of them. Compared with the float head, 8 bits cost 0.01 in the root mean square."""
    random = np.random.default_rng(1)
    seen = random.normal(0, 40, (4000, N_CHANNELS))
    dirs = random.normal(size=(4000, 3))
    dirs /= np.linalg.norm(dirs, axis=-1, keepdims=True)
    ranges = activation_ranges(weights, seen, dirs)
    for label, features, dirs, rgb in answers(exported(asset, tmp_path, head_onnx(weights, ranges), decode)):
        expected = quantised(weights, ranges, torch.from_numpy(features), torch.from_numpy(dirs)).numpy()
        assert rgb.shape == expected.shape, label
        INT8.check(rgb, expected)
        if label in ("random", "random floats"):
            with torch.no_grad():
                x = torch.from_numpy(features.astype(np.float64) * SCALE)
                exact = head(x, torch.from_numpy(dirs.astype(np.float64))).numpy()
            INT8_COST.check(np.sqrt(np.mean((rgb - exact) ** 2)))
            assert not np.array_equal(rgb, exact), label


def quantised(
    weights: HeadWeights, ranges: tuple[Range, ...], features: torch.Tensor, dirs: torch.Tensor
) -> torch.Tensor:
    """Return the rgb of the head with the rounding of `exporters.head.onnx_head`, done by torch."""

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.tensor(array, dtype=torch.float32)

    def rounded(x: torch.Tensor, limits: Range) -> torch.Tensor:
        scale = (limits[1] - limits[0]) / 255
        x = x.clamp(limits[0] - scale, limits[1] + scale)  # older versions of torch wrap levels beyond 2^63
        return torch.fake_quantize_per_tensor_affine(x, scale, round(-limits[0] / scale), 0, 255)

    def layer(x: torch.Tensor, weight: np.ndarray, bias: np.ndarray) -> torch.Tensor:
        w = tensor(weight)
        scales = torch.from_numpy(weight_scales(weight))
        zeros = torch.zeros(len(scales), dtype=torch.int32)
        w = torch.fake_quantize_per_channel_affine(w, scales, zeros, 1, -127, 127)
        return x @ w + tensor(bias)

    activation = gelu if weights.activation == "gelu" else hardswish
    ((weight, bias),) = weights.spatial
    h = rounded(activation(features @ tensor(weight) + tensor(bias)), ranges[0])
    basis = SphericalHarmonics(weights.sh_degree)(dirs).repeat_interleave(weights.n_sh_features, dim=-1)
    d_bottleneck, d_sh, bias = weights.directional_first
    encoded = rounded(layer(h, *weights.to_sh) * basis, ranges[1])
    z = activation(layer(h, d_bottleneck, bias) + layer(encoded, d_sh, np.zeros_like(bias)))
    for limits, (weight, bias) in zip(ranges[2:], weights.directional, strict=True):
        z = activation(layer(rounded(z, limits), weight, bias))
    weight, bias = weights.output
    return torch.sigmoid(z @ tensor(weight) + tensor(bias))
