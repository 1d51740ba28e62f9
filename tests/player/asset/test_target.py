"""A folder is replaced by an asset only if it holds an asset and nothing else, or nothing at all."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from player.asset.asset import Asset, write_asset
from player.asset.target import asset_files, check_asset_target
from player.errors import OutputError


def test_an_asset_is_replaced_with_force_alone(shells_folder: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(shells_folder, tmp_path / "out"))
    for name in (".DS_Store", "._report.html", ".directory", "THUMBS.DB", "Desktop.ini"):
        (folder / name).write_bytes(b"a system was here")
    (folder / "@eaDir").mkdir()
    with pytest.raises(OutputError, match="already exists: add --force"):
        check_asset_target(folder)
    check_asset_target(folder, force=True)
    document = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(document | {"version": [2, 0]}))
    (folder / "cameras.json").unlink()
    check_asset_target(folder, force=True)


@pytest.mark.parametrize("manifest", [None, b"{}", b"[1]", b"not JSON", b'{"format": "others"}'])
def test_a_folder_of_something_else_is_kept(manifest: bytes | None, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "manifest.json" if manifest else folder / "IMG_1.jpg").write_bytes(manifest or b"a photograph")
    assert asset_files(folder) is None
    with pytest.raises(OutputError, match=r"expected no folder, or one of an asset alone, got \S+ in it"):
        check_asset_target(folder, force=True)


def test_an_empty_folder_is_filled(shells_folder: Path, tmp_path: Path) -> None:
    asset, folder = Asset.open(shells_folder), tmp_path / "out"
    folder.mkdir()
    (folder / ".DS_Store").write_bytes(b"Finder was here")
    head, mesh, cameras = (asset.read(name) for name in ("head.onnx", "mesh.ply", "cameras.json"))
    write_asset(folder, asset.manifest, asset.arrays, head, mesh, cameras)
    assert Asset.open(folder, verify=True).manifest.resolution == asset.manifest.resolution


@pytest.mark.parametrize("name", [".git", ".mine", "eaDir", "_.txt"])
def test_hidden_files_of_people_are_kept(name: str, shells_folder: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(shells_folder, tmp_path / "out"))
    (folder / name).mkdir()
    advice = re.escape(f"got {name} in it: name another folder, or move {name} out of it")
    with pytest.raises(OutputError, match=advice):
        check_asset_target(folder, force=True)


def test_files_beside_those_of_an_asset_are_kept(shells_folder: Path, tmp_path: Path) -> None:
    asset = Asset.open(shells_folder)
    folder = Path(shutil.copytree(shells_folder, tmp_path / "out"))
    (folder / "mine.txt").write_text("mine")
    rest = (asset.read(name) for name in ("head.onnx", "mesh.ply", "cameras.json"))
    with pytest.raises(OutputError, match=r"got mine\.txt in it: name another"):
        write_asset(folder, asset.manifest, asset.arrays, *rest, force=True)
    assert (folder / "mine.txt").read_text() == "mine"


def test_a_file_is_not_replaced_by_a_folder(tmp_path: Path) -> None:
    (tmp_path / "model.pt").write_bytes(b"")
    with pytest.raises(OutputError, match="expected a folder to write, got a file"):
        check_asset_target(tmp_path / "model.pt", force=True)
