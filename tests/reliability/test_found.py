"""Faults that broken inputs have shown, each with a test."""

from __future__ import annotations

import json
import math
import os
import shutil
import struct
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from exporters.shapes.crop import parse_crop
from player.asset.asset import Asset
from player.asset.manifest import NAME, parse_manifest
from player.asset.version_3.unpacking import read_arrays, read_coords
from player.cameras.transforms import parse_transforms, transforms_cameras
from player.errors import ConfigError, DataError, FormatError
from player.files.images import png_bytes, read_key
from tests.player.conftest import cameras_bytes, head_bytes
from tests.reliability.hostile_files import vouch
from tests.version_3 import as_version_3, pack_codes, pack_masks
from vfr_bake.config import FieldConfig, field_config_from
from vfr_bake.data.files.pictures import read_picture
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.training.model_file import FORMAT, Model, load_model, save_model


@pytest.fixture(scope="module")
def small_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.pt"
    field = VfrField(FieldConfig(n_levels=2, max_resolution=16, log2_table_size=10, head_width=8))
    cameras = transforms_cameras(parse_transforms(cameras_bytes(), "cameras"), "cameras")
    save_model(path, Model(field, OccupancyGrid(8, 0.2, seed=0), np.eye(4), cameras, False, {}, {}))
    return path


@pytest.fixture
def broken(shells_folder: Path, tmp_path: Path) -> Path:
    """A copy of the asset that a test may break."""
    return Path(shutil.copytree(shells_folder, tmp_path / "broken"))


def test_a_npy_header_that_never_ends() -> None:
    """A header that never ends is refused, although numpy tries it as Python 2's and its tokenizer fails."""
    header = b"{'descr': '<u2', 'fortran_order': False, 'shape': (1, 3"
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    with pytest.raises(FormatError, match="expected a numpy array of uint16"):
        read_coords(data, "brick_coords.npy")


def test_a_key_of_five_thousand_letters(shells_folder: Path) -> None:
    document = json.loads((shells_folder / NAME).read_bytes())
    document["a\n" * 2500] = 1
    with pytest.raises(FormatError, match="expected no such key") as caught:
        parse_manifest(json.dumps(document).encode(), NAME)
    assert len(str(caught.value)) < 200 and "\n" not in str(caught.value)


def test_tensors_where_a_model_has_plain_values(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    torch.save({"format": FORMAT, "version": torch.zeros(5)}, path)
    with pytest.raises(FormatError, match="version: expected two integers") as caught:
        load_model(path)
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="expected the settings") as refused:
        field_config_from({1: 2, "b": torch.zeros(3, 3)}, "model.pt: field")
    assert "\n" not in str(refused.value)


def test_an_asset_without_a_feature(broken: Path) -> None:
    """An asset without features is refused: rays that hit something found no row to take."""
    asset = Asset.open(as_version_3(broken))
    _, features = read_arrays(asset.folder, asset.manifest, 1 << 40)
    for name, data in (
        ("feature_masks.bits", pack_masks(np.zeros_like(features.masks))),
        ("features.codes", pack_codes(features.values[:0])),
    ):
        (broken / name).write_bytes(data)
    vouch(broken)
    with pytest.raises(FormatError, match=r"feature_masks\.bits: expected at least one stored vertex"):
        Asset.open(broken)


def test_a_box_of_huge_numbers(tmp_path: Path) -> None:
    path = tmp_path / "box.json"
    path.write_text(json.dumps({"centre": [10**400, 0, 0], "size": [1, 1, 1]}))
    with pytest.raises(FormatError, match=r"centre: expected \[3\] finite numbers"):
        parse_crop(str(path))


def test_an_angle_below_every_number() -> None:
    document = json.loads(cameras_bytes())
    document["camera_angle_x"] = 1e-308
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cameras = transforms_cameras(parse_transforms(json.dumps(document).encode(), "t"), "t")
    assert all(math.isfinite(camera.fx) and camera.fx > 1e300 for camera in cameras)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("sampler", {"occupied": torch.zeros(64)}, "occupied: expected a plain tensor of bytes, got float32"),
        (
            "sampler",
            {"occupied": torch.zeros(64, dtype=torch.uint8).to_sparse()},
            "expected plain tensors and values, got torch",
        ),
        ("field", {"compositing": "a" * 5000}, "expected one of features, colour, got aaa"),
        ("cameras", "\ud800", "expected JSON"),
    ],
)
def test_values_of_a_model_that_are_none_of_ours(
    key: str, value: Any, message: str, small_model: Path, tmp_path: Path
) -> None:
    content = torch.load(small_model, weights_only=True)
    content[key] = content[key] | value if isinstance(value, dict) else value
    path = tmp_path / "model.pt"
    torch.save(content, path)
    with pytest.raises(FormatError, match=message) as caught:
        load_model(path)
    assert len(str(caught.value)) < 300 and "\n" not in str(caught.value)


def test_onnxruntime_calls_nobody(tmp_path: Path) -> None:
    """onnxruntime connects to nobody: from 1.31 on a thread of its own looked up its maker's server."""
    (tmp_path / "head.onnx").write_bytes(head_bytes(4))
    code = (
        "import os, sys, time; from pathlib import Path; from player.head.head import Head\n"
        f"Head(Path({str(tmp_path / 'head.onnx')!r}).read_bytes(), 4); time.sleep(0.5)\n"
        "print('onnxruntime' in sys.modules, len(os.listdir('/proc/self/task')))"
    )
    alone = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    environment = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment | alone
    )
    assert done.stdout == "True 1\n", done.stdout + done.stderr


def test_a_name_of_thousands_of_letters_is_not_repeated_in_full() -> None:
    document = json.loads(cameras_bytes())
    document["frames"][0] |= {"file_path": "a" * 5000, "transform_matrix": 3}
    with pytest.raises(FormatError) as caught:
        transforms_cameras(parse_transforms(json.dumps(document).encode(), "t"), "t")
    assert "frame 0" in str(caught.value) and len(str(caught.value)) < 400


def test_a_picture_that_asks_for_more_memory_than_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A PNG of 324 bytes that claims 4 GB, for which Pillow asks the system at once, is refused."""
    path = tmp_path / "frame.png"
    path.write_bytes(png_bytes(np.zeros((9, 7, 3), np.uint8), "abc"))
    assert read_key(path) == "abc"

    def load(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", load)
    assert read_key(path) is None
    with pytest.raises(DataError, match=r"frame\.png: picture: cannot be read to its end: MemoryError"):
        read_picture(path)
