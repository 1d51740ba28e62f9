"""Photographs for tests of `vfr-bench`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from player.asset.asset import Asset
from player.cameras.transforms import read_cameras, write_cameras
from player.render import render


@pytest.fixture(scope="module")
def data(shells_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The asset's views as a NeRF-synthetic folder."""
    folder = tmp_path_factory.mktemp("shells")
    asset = Asset.open(shells_folder)
    cameras = read_cameras(asset.path("cameras.json"))
    for split, some in (("train", cameras[:3]), ("test", cameras[3:])):
        named = [replace(camera, name=f"./{split}/photo_{i}") for i, camera in enumerate(some)]
        (folder / split).mkdir()
        for camera in named:
            frame = render(asset, camera, n_fetches=0, march="numba")
            Image.fromarray(frame.to_uint8()).convert("RGBA").save(folder / f"{camera.name}.png")
        (folder / f"transforms_{split}.json").write_bytes(write_cameras(named))
    return folder
