"""Tests of assets of version 3.1: one that was kept plays as it did then, and broken ones are refused."""

from __future__ import annotations

import io
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from player.asset.asset import Asset, checksums
from player.asset.bricks import stored_bits
from player.asset.manifest import FILES_OF_3
from player.asset.version_3.packing import unpack_codes
from player.asset.version_3.unpacking import read_arrays
from player.cameras.views import asset_cameras
from player.errors import FormatError, IntegrityError
from player.render import Renderer
from tests.player.asset.test_asset import edit, replace_file
from tests.version_3 import pack_codes, pack_masks

KEPT = Path(__file__).parent / "version_3_1"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """Return a copy of the asset that the test may break."""
    return Path(shutil.copytree(KEPT / "asset", tmp_path / "old"))


def test_it_plays_as_it_did() -> None:
    asset = Asset.open(KEPT / "asset", verify=True)
    assert asset.manifest.version == (3, 1) and asset.manifest.n_fetches == 4
    assert (asset.n_parts, asset.missing) == (0, None)
    camera = asset_cameras(asset)[0].resized(24, 20)
    with np.load(KEPT / "played.npz") as played, Renderer(asset, 1, "numpy") as renderer:
        frame = renderer.render(camera)
        assert np.array_equal(frame.n_density_samples, played["n_density_samples"])
        assert frame.opacity.max() > 0.9 and np.ptp(frame.rgb) > 0.5
        for name in ("rgb", "opacity", "depth"):
            assert np.abs(getattr(frame, name) - played[name]).max() < 1e-5, name


def test_its_values_are_those_of_its_files() -> None:
    asset = Asset.open(KEPT / "asset")
    stored = read_arrays(asset.folder, asset.manifest, 1 << 40)
    for grid, files in zip((asset.arrays.densities, asset.arrays.features), stored, strict=True):
        assert len(grid.pyramid.levels) == 1
        assert np.array_equal(grid.pyramid.vertices[0].bricks.masks, files.masks)
        assert np.array_equal(grid.values[0], files.values.reshape(len(files.values), -1))
        assert stored_bits(files.masks).sum() == len(files.values)


@pytest.mark.parametrize("shape", [(0,), (1,), (70,), (0, 3), (1, 3), (70, 1), (70, 5)])
def test_packed_codes_come_back(shape: tuple[int, ...]) -> None:
    for dtype in (np.int8, np.uint8):
        info = np.iinfo(dtype)
        codes = np.random.default_rng(0).integers(info.min, info.max + 1, shape, dtype)
        again = unpack_codes(pack_codes(codes), shape, np.dtype(dtype).str[1:], "codes")
        assert again.dtype == dtype and np.array_equal(again, codes)


@pytest.mark.parametrize("name", FILES_OF_3)
def test_missing_cut_and_changed_files_are_named(name: str, old: Path) -> None:
    path = old / name
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(IntegrityError, match=rf"{name}: sha256: expected [0-9a-f]{{16}}\.\.\., got"):
        Asset.open(old, verify=True)
    assert [n for n, error in checksums(old, Asset.open(KEPT / "asset").manifest) if error] == [name]
    path.write_bytes(data[:-1])
    unread = name == "mesh.ply"  # nothing but a verification looks at it
    with pytest.raises(IntegrityError, match=rf"{name}: size: expected {len(data)} bytes, got"):
        Asset.open(old, verify=unread)
    path.unlink()
    with pytest.raises(FormatError, match=rf"{name}: no such file: expected a file of {len(data)} bytes"):
        Asset.open(old, verify=unread)
    if unread:
        assert Asset.open(old).missing is None


def npy(array: np.ndarray, **options: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, **options)
    return buffer.getvalue()


def test_arrays_that_do_not_fit(old: Path) -> None:
    densities, features = read_arrays(old, Asset.open(old).manifest, 1 << 40)
    codes, packed = densities.values, pack_codes(densities.values)
    bad: list[tuple[str, bytes, str]] = [
        ("density.codes", pack_codes(codes[:-1]), f"expected {len(codes)} packed codes, got"),
        ("density.codes", pack_codes(np.append(codes, np.uint8(0))), "packed codes, got more"),
        ("density.codes", pack_codes(np.zeros(1 << 20, np.uint8)), "packed codes, got more"),
        ("density.codes", packed + b"tail", "packed codes, got more"),
        ("density.codes", packed[:-9], "packed codes, got"),
        ("density.codes", b"PK\x03\x04 not a stream", "expected packed codes, got something else"),
        ("density.codes", b"", f"expected {len(codes)} packed codes, got 0"),
        ("features.codes", pack_codes(features.values[:, :3]), "packed codes, got"),
        ("brick_coords.npy", npy(densities.coords[::-1].copy()), "expected bricks sorted"),
        ("brick_coords.npy", npy(densities.coords[:-1]), "packed bytes, got more"),
        ("brick_coords.npy", npy(densities.coords + np.uint16(1)), "expected coordinates below 3"),
        ("brick_coords.npy", npy(np.asfortranarray(densities.coords)), "C order"),
        ("brick_coords.npy", npy(np.array([{}], object), allow_pickle=True), "expected a numpy array"),
        ("brick_coords.npy", npy(densities.coords) + b"tail", "bytes as its header says"),
        ("brick_coords.npy", b"PK\x03\x04 not an array", "expected a numpy array"),
        ("brick_coords.npy", b"", "expected a numpy array"),
        ("brick_masks.bits", npy(densities.masks), "expected packed bytes, got something else"),
        ("brick_masks.bits", pack_masks(densities.masks)[:-9], "packed bytes, got"),
        ("feature_coords.npy", npy(features.coords[::-1].copy()), "expected bricks sorted"),
        ("feature_masks.bits", pack_masks(features.masks[:-1]), "packed bytes, got"),
        ("feature_masks.bits", pack_masks(features.masks & np.uint64(0)), "at least one stored vertex"),
    ]
    for name, data, message in bad:
        good = (old / name).read_bytes()
        replace_file(old, name, data)
        with pytest.raises(FormatError, match=message) as caught:
            Asset.open(old)
        assert re.search(r"\.(npy|bits|codes): ", str(caught.value)) and "\n" not in str(caught.value)
        replace_file(old, name, good)
    Asset.open(old)


def test_vertices_beyond_the_grid(old: Path) -> None:
    edit(old, lambda m: m.update(resolution=15))
    with pytest.raises(FormatError, match="expected coordinates below 2, got 2"):
        Asset.open(old)
    edit(old, lambda m: m.update(resolution=20))
    with pytest.raises(FormatError, match="expected vertices below 21, got one at 21"):
        Asset.open(old)


def test_keys_of_another_version_are_refused(old: Path) -> None:
    for key in ("n_fetches", "parts", "level_steps"):
        shutil.copyfile(KEPT / "asset" / "manifest.json", old / "manifest.json")
        edit(old, lambda m, key=key: m.update({key: 1}))
        with pytest.raises(
            FormatError, match=rf"{key} in version 3: expected no such key in version \[3, 1\]"
        ):
            Asset.open(old)


def test_version_3_0_begins_at_the_camera(old: Path) -> None:
    document = json.loads((old / "manifest.json").read_text())
    del document["near"]
    (old / "manifest.json").write_text(json.dumps(document))
    with pytest.raises(FormatError, match="near: expected this key"):
        Asset.open(old)
    (old / "manifest.json").write_text(json.dumps(document | {"version": [3, 0]}))
    assert Asset.open(old).manifest.near == 0
