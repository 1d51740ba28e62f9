"""What broken inputs have brought to light, one by one."""

from __future__ import annotations

import json
import math
import struct
import warnings
from pathlib import Path

import pytest
import torch

from player.asset import _map_array
from player.errors import ConfigError, FormatError
from player.manifest import NAME, parse_manifest
from player.transforms import parse_transforms, transforms_cameras
from tests.player.conftest import cameras_bytes
from vfr_bake.config import field_config_from
from vfr_bake.training.model_file import FORMAT, load_model


def test_a_npy_header_that_never_ends(tmp_path: Path) -> None:
    """numpy tries it again as Python 2 wrote it, and its tokenizer gives up in its own way."""
    header = b"{'descr': '<u2', 'fortran_order': False, 'shape': (1, 3"
    path = tmp_path / "brick_coords.npy"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    with pytest.raises(FormatError, match="expected a numpy array, got something else"):
        _map_array(path)


def test_a_key_of_five_thousand_letters(shells_folder: Path) -> None:
    document = json.loads((shells_folder / NAME).read_bytes())
    document["a\n" * 2500] = 1
    with pytest.raises(FormatError, match="expected no such key") as caught:
        parse_manifest(json.dumps(document).encode(), NAME)
    assert len(str(caught.value)) < 200 and "\n" not in str(caught.value)


def test_tensors_where_a_model_has_plain_values(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    torch.save({"format": FORMAT, "version": torch.zeros(5).to_sparse()}, path)
    with pytest.raises(FormatError, match="version: expected two integers") as caught:
        load_model(path)
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="expected the settings") as refused:
        field_config_from({1: 2, "b": torch.zeros(3, 3)}, "model.pt: field")
    assert "\n" not in str(refused.value)


def test_an_angle_below_every_number() -> None:
    document = json.loads(cameras_bytes())
    document["camera_angle_x"] = 1e-308
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cameras = transforms_cameras(parse_transforms(json.dumps(document).encode(), "t"), "t")
    assert all(math.isfinite(camera.fx) and camera.fx > 1e300 for camera in cameras)
