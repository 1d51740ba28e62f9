"""Tests of the exported head: it is valid, describes itself, and gives the asset's own colours."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from exporters import cli
from exporters.head import asset_head
from exporters.head.asset_head import TOLERANCE, comparisons, head_bytes
from exporters.head.onnx_head import head_onnx
from exporters.head.ranges import activation_ranges
from player.asset.asset import Asset
from player.asset.manifest import file_entry
from player.errors import MissingExtraError, ParityError
from player.head.head import Head
from tests.exporters.head.test_onnx_head import inputs, random_head


@pytest.fixture(params=["float32", "int8"])
def with_real_head(request: pytest.FixtureRequest, opened: Asset, tmp_path: Path) -> Asset:
    """Return a copy of the asset with a head of random weights as the bake writes it, for four channels."""
    weights = random_head(n_channels=4)
    ranges = activation_ranges(weights, *inputs(500, 4)) if request.param == "int8" else None
    return with_head(opened, tmp_path / "asset", head_onnx(weights, ranges))


def with_head(asset: Asset, folder: Path, data: bytes) -> Asset:
    """Return a copy of an asset in a new folder, with the head in `data`."""
    shutil.copytree(asset.folder, folder)
    (folder / "head.onnx").write_bytes(data)
    entry = file_entry(data)
    manifest = replace(asset.manifest, files=asset.manifest.files | {"head.onnx": entry})
    return replace(asset, folder=folder, manifest=manifest)


def notes(data: bytes) -> dict[str, str]:
    return {entry.key: entry.value for entry in onnx.load_from_string(data).metadata_props}


@pytest.mark.parametrize("decode", [False, True])
def test_is_the_asset_s_head(decode: bool, with_real_head: Asset) -> None:
    data = head_bytes(with_real_head, decode)
    assert data == head_bytes(with_real_head, decode)
    model = onnx.load_from_string(data)
    onnx.checker.check_model(model, full_check=True)
    names = ["codes", "weights", "dirs"] if decode else ["features", "dirs"]
    assert [value.name for value in model.graph.input] == names
    assert [value.name for value in model.graph.output] == ["rgb"]
    found = notes(data)
    assert found["vfr.opset"] == "20" and found["vfr.tolerance"] == "1e-06"
    assert float(found["vfr.worst_difference"]) <= TOLERANCE
    assert found["vfr.layers"] in ("float32", "int8") and found["vfr.inputs"] == ", ".join(names)


def test_decode_takes_any_number_of_pixels_and_fetches(with_real_head: Asset) -> None:
    """The model that decodes agrees with numpy and the player's head, but for rounding of float32 sums."""
    session = onnxruntime.InferenceSession(
        head_bytes(with_real_head, True), providers=["CPUExecutionProvider"]
    )
    head = Head.of(with_real_head)
    is_int8 = notes(head_bytes(with_real_head, True))["vfr.layers"] == "int8"
    random = np.random.default_rng(1)
    for n, k in ((0, 5), (1, 1), (7, 5), (300, 12)):
        codes = random.integers(-128, 128, (n, k, 4)).astype(np.int8)
        weights = (random.random((n, k)) / k).astype(np.float32)
        _, dirs = inputs(n, 4)
        rgb = np.asarray(session.run(["rgb"], {"codes": codes, "weights": weights, "dirs": dirs})[0])
        features = (weights[..., None] * codes).sum(axis=1, dtype=np.float64).astype(np.float32)
        assert rgb.shape == (n, 3)
        # an 8-bit layer may round the other way: one level of one of 32 activations
        np.testing.assert_allclose(rgb, head(features, dirs), rtol=0, atol=0.02 if is_int8 else 1e-4)


def test_comparisons_are_exact_in_float32() -> None:
    labels = set()
    for label, features, codes, weights, dirs in comparisons(4):
        labels.add(label)
        assert features.dtype == dirs.dtype == np.float32 and len(features) == len(dirs)
        np.testing.assert_allclose(np.linalg.norm(dirs, axis=-1), 1, atol=1e-6)
        if codes is not None and weights is not None:
            assert codes.dtype == np.int8 and weights.dtype == np.float32
            forth = np.zeros_like(features)
            for index in range(codes.shape[1]):
                forth += weights[:, index, None] * codes[:, index]
            assert np.array_equal(forth, features)
    assert {"no pixel", "one pixel", "lowest codes", "highest codes", "subnormal", "1e30"} <= labels


@pytest.mark.parametrize("decode", [False, True])
def test_another_head_is_noticed(
    decode: bool, with_real_head: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A weight that was changed while the graph was edited is noticed by the comparison."""
    original = asset_head._compare

    def damaged(asset: Asset, data: bytes, decode: bool, where: str) -> float:
        model = onnx.load_from_string(data)
        bias = next(t for t in model.graph.initializer if t.name == "output_bias")
        changed = onnx.numpy_helper.to_array(bias) + np.float32(0.01)
        bias.CopyFrom(onnx.numpy_helper.from_array(changed, "output_bias"))
        return original(asset, model.SerializeToString(), decode, where)

    monkeypatch.setattr(asset_head, "_compare", damaged)
    with pytest.raises(ParityError, match=r"head\.onnx: rgb, one pixel: pixel 0: expected"):
        head_bytes(with_real_head, decode)


def test_command(shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "head.onnx"
    assert cli.main([str(shells_asset), str(target), "--decode"]) == 0
    assert f"{target}: codes, weights, dirs -> rgb" in capsys.readouterr().out
    assert notes(target.read_bytes())["vfr.opset"] == "20"


def test_without_onnx(opened: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'vfr-bake\[export\]'"):
        head_bytes(opened)
