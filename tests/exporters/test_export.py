"""Tests of `vfr-export`: which settings go with which format, what it prints, and one-line refusals."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import stat
import struct
from pathlib import Path

import numpy as np
import pytest

from exporters import cli, export
from exporters.options import ExportOptions, check_options
from player.app.option_types import part, size
from player.asset.asset import Asset
from player.cameras.nerfstudio import write_camera_path
from player.cameras.transforms import frame_names
from player.cameras.views import asset_cameras, read_views
from player.errors import ConfigError, ParityError
from tests.exporters.meshes import read_ply

REPOSITORY = Path(__file__).resolve().parents[2]


def fails(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run `vfr-export`, check for exit code 1 and one line on stderr, and return that line."""
    assert cli.main(arguments) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("vfr-export: error: ")
    assert captured.err.count("\n") == 1
    return captured.err


def test_crop_and_what_it_prints(
    shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A crop is applied and reported, also if it begins with a minus, which argparse takes for an option."""
    target = tmp_path / "part.ply"
    arguments = [str(shells_asset), str(target), "--crop", "-8.5,2.375,3.5,20,4,4", "--method", "baked"]
    assert cli.main(arguments) == 0
    captured = capsys.readouterr()
    assert "the crop removed 83.3% of the faces" in captured.out  # the two triangles at x = 1.25 stay
    mesh = read_ply(target)
    assert len(mesh.faces) == 2 and (mesh.vertices[:, 0] == 1.25).all()
    assert cli.main([*arguments, "--json", "--force"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["removed"] == pytest.approx(10 / 12) and summary["frame"] == "world"


def test_crop_is_in_world_units_in_every_frame(shells_asset: Path, tmp_path: Path) -> None:
    for frame in ("world", "model", "gltf"):
        summary = export.export_asset(
            shells_asset,
            tmp_path / f"{frame}.stl",
            ExportOptions(frame=frame, crop="0,2.375,3.5,3,4,4", method="baked"),
        )
        assert summary["faces"] == 2 and summary["bounds"][1][0] == 1.25


@pytest.mark.parametrize("arguments", ["a.glb", "a.ply --points 9", "d --format colmap --points 9"])
def test_the_stored_mesh_needs_no_density(
    arguments: str, shells_asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With --method baked the densities are not brought to one level, which may take much memory."""

    def refuse(*_: object) -> None:
        raise AssertionError("the densities are brought to one level")

    monkeypatch.setattr(export, "inner_region", refuse)
    name, *more = shlex.split(arguments)
    assert cli.main([str(shells_asset), str(tmp_path / name), *more, "--method", "baked"]) == 0
    with pytest.raises(AssertionError, match="one level"):
        cli.main([str(shells_asset), str(tmp_path / name), *more, "--force"])


def test_format_overrules_the_suffix(shells_asset: Path, tmp_path: Path) -> None:
    target = tmp_path / "mesh.bin"
    assert cli.main([str(shells_asset), str(target), "--format", "stl", "--method", "baked"]) == 0
    assert target.read_bytes().startswith(b"vfr-bake: binary STL")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            "a.fbx",
            ".stl, .usdc, .usda, .vdb, .npz, .json, .html, .onnx, or a folder with --format",
        ),
        ("frames/", "got none"),
        (
            "a.ply --format usd",
            "vdb, npz, json, html, onnx, exr, colmap, web, got usd",
        ),
        ("a.ply --faces 0", "--faces: expected 1 or more, got 0"),
        ("a.ply --points 0", "--points: expected 1 to 10000000, got 0"),
        ("d --format colmap --points 10000000000", "--points: expected 1 to 10000000, got 10000000000"),
        ("a.ply --crop 9,9,9,1,1,1", "--crop: expected a box with some of the mesh in it"),
        ("a.ply --crop 1,2", "--crop: expected X,Y,Z,W,D,H[,YAW]"),
        ("a.glb --crop none.json", "none.json: no such file"),
        ("a.obj --points 5", "--points does nothing for a obj mesh; it takes --crop, --faces, --frame"),
        ("a.ply --points 5 --faces 5", "--faces does nothing for a point cloud"),
        ("a.json --crop 0,0,0,9,9,9", "--crop does nothing for json; it takes --frame"),
        ("a.onnx --half", "--half does nothing for onnx; it takes --decode"),
        ("a.vdb --faces 9", "--faces does nothing for a vdb volume; it takes --colour, --crop, --frame"),
        ("a.glb --colour", "--colour does nothing for a glb mesh"),
        ("dir --format colmap --views 1", "--views does nothing for colmap"),
    ],
)
def test_one_line_and_nothing_written(
    arguments: str, message: str, shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target, *more = shlex.split(arguments)
    assert message in fails([str(shells_asset), str(tmp_path / target), *more], capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments",
    [
        *("a.stl", "a.json", "a.vdb", "a.npz", "a.usdc", "a.onnx", "a.ply --points 9"),
        *("d --format colmap", "d --format exr --size 5x4"),
    ],
)
def test_targets_that_cannot_be_written(
    arguments: str, shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *more = shlex.split(arguments)
    (tmp_path / "file").write_text("mine")
    error = fails([str(shells_asset), str(tmp_path / "file" / name), *more], capsys)
    assert "is a file, not a folder" in error
    assert (tmp_path / "file").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


def test_read_only_folder_and_file(
    shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read-only targets are refused. `os.access` is replaced, because root may write everywhere."""

    def access(path: str | Path, mode: int) -> bool:
        return not mode & os.W_OK or bool(Path(path).stat().st_mode & stat.S_IWUSR)

    monkeypatch.setattr(os, "access", access)
    locked = tmp_path / "locked"
    locked.mkdir()
    (locked / "old.stl").write_text("mine")
    (locked / "old.stl").chmod(0o444)
    assert "it is read-only" in fails([str(shells_asset), str(locked / "old.stl"), "--force"], capsys)
    locked.chmod(0o555)
    try:
        error = fails([str(shells_asset), str(locked / "new" / "a.stl")], capsys)
        assert f"the folder {locked} is read-only" in error
        fails([str(shells_asset), str(locked / "frames"), "--format", "exr"], capsys)
        assert [path.name for path in locked.iterdir()] == ["old.stl"]
        assert (locked / "old.stl").read_text() == "mine"
    finally:
        locked.chmod(0o755)


def test_pictures_are_taken_from_a_camera_path_as_vfr_play_takes_them(
    shells_asset: Path, tmp_path: Path
) -> None:
    cameras = [camera.resized(6, 4) for camera in asset_cameras(Asset.open(shells_asset))[:2]]
    path = tmp_path / "camera_path.json"
    path.write_bytes(write_camera_path(cameras, fps=30))
    options = ["--format", "exr", "--cameras", str(path)]
    assert cli.main([str(shells_asset), str(tmp_path / "frames"), *options]) == 0
    names = [f"{name}.exr" for name in frame_names(read_views(path))]
    assert sorted(file.name for file in (tmp_path / "frames").iterdir()) == sorted(names)
    assert len(names) == 2


@pytest.mark.parametrize("kind", ["exr", "colmap"])
def test_a_folder_with_other_things_is_not_replaced(
    kind: str, shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "pictures"
    target.mkdir()
    (target / "holiday.png").write_text("mine")
    error = fails([str(shells_asset), str(target), "--format", kind, "--force"], capsys)
    wanted = f"expected no folder, or one of {kind} files that vfr-export wrote, got holiday.png in it"
    assert wanted in error
    assert (target / "holiday.png").read_text() == "mine"
    error = fails([str(shells_asset), str(target), "--format", "stl", "--force"], capsys)
    assert "expected the name of a file, got a folder" in error
    error = fails([str(shells_asset), str(target / "holiday.png"), "--format", kind, "--force"], capsys)
    assert "expected the name of a folder, got a file" in error


COLMAP_S_TEXT = {
    "cameras.txt": "# Camera list with one line of data per camera:\n1 PINHOLE 4 3 5 5 2 1.5\n",
    "images.txt": "# Image list with two lines of data per image:\n1 1 0 0 0 0 0 0 1 a.png\n2 1 -1\n",
    "points3D.txt": "# 3D point list with one line of data per point:\n",
}


@pytest.mark.parametrize("kind", ["exr", "text", "keypoints", "tracks", "distorted", "web"])
def test_a_folder_of_other_programs_files_is_not_replaced(
    kind: str, shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Files that another program wrote under the names of an export are kept, for example the model of
    COLMAP that the photographs came with."""
    radial = struct.pack("<QIiQQ4d", 1, 1, 2, 4, 3, 5, 2, 1.5, 0.1)
    image = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0"
    point = struct.pack("<QQ3d3Bd", 1, 1, 0, 0, 0, 9, 9, 9, 0)
    none = bytes(8)
    contents: dict[str, dict[str, bytes]] = {
        "exr": {"a.exr": b"v/1\x01" + bytes(99)},
        "text": {name: text.encode() for name, text in COLMAP_S_TEXT.items()},
        "keypoints": {"images.bin": image + struct.pack("<QddQ", 1, 2, 1, 2**64 - 1)},
        "tracks": {"images.bin": image + none, "points3D.bin": point + struct.pack("<QII", 1, 1, 0)},
        "distorted": {"cameras.bin": radial},
        "web": {"index.html": b"mine", "main.js": b"mine", "manifest.json": b'{"name": "mine"}'},
    }
    target = tmp_path / "mine"
    target.mkdir()
    for name, data in contents[kind].items():
        (target / name).write_bytes(data)
    name = kind if kind in ("exr", "web") else "colmap"
    error = fails([str(shells_asset), str(target), "--format", name, "--force"], capsys)
    assert f"expected no folder, or one of {name} files that vfr-export wrote, got " in error
    assert {path.name: path.read_bytes() for path in target.iterdir()} == contents[kind]


@pytest.mark.parametrize(
    "arguments", ["--format exr --views 0 --size 5x4", "--format colmap --points 9", "--format web"]
)
def test_an_earlier_export_is_replaced(arguments: str, shells_asset: Path, tmp_path: Path) -> None:
    command = [str(shells_asset), str(tmp_path / "d"), *shlex.split(arguments)]
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / ".DS_Store").touch()  # does not count: the folder is empty
    assert cli.main(command) == 0
    (tmp_path / "d" / ".DS_Store").touch()
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "d").iterdir()}
    assert cli.main([*command, "--force"]) == 0
    after = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "d").iterdir()}
    assert sorted([*after, ".DS_Store"]) == sorted(before)
    assert any(after[name] != before[name] for name in after)


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_the_asset_is_not_overwritten(
    force: list[str], shells_asset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its own files are refused, and others in its folder are exports like any other."""
    for name in ("mesh.ply", "head.onnx", "cameras.json"):
        error = fails([str(shells_asset), str(shells_asset / name), *force], capsys)
        assert f"{name}: is part of the asset" in error
    assert fails([str(shells_asset), str(shells_asset), "--format", "exr", *force], capsys)
    new = shells_asset / "new.npz"
    assert cli.main([str(shells_asset), str(new), *force]) == 0
    assert cli.main([str(shells_asset), str(new), "--force"]) == 0
    Asset.open(shells_asset, verify=True)


def test_an_export_that_fails_its_comparison_leaves_the_old_file(
    shells_asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from exporters.formats import exr, stl

    target = tmp_path / "a.stl"
    target.write_text("old")
    original = stl.stl_bytes
    monkeypatch.setattr(stl, "stl_bytes", lambda mesh: original(mesh)[:-10] + b"\0\0\x80\x3f" * 2 + b"\0\0")
    assert "corners: number" in fails([str(shells_asset), str(target), "--force"], capsys)
    assert target.read_text() == "old"

    def differs(*arguments: object) -> None:
        raise ParityError("a.exr: Z: expected 1, got 2")

    monkeypatch.setattr(exr, "check_channels", differs)
    fails([str(shells_asset), str(tmp_path / "frames"), "--format", "exr", "--size", "5x4"], capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["a.stl"]


def test_missing_extra_is_named(
    shells_asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import sys

    for module in ("open3d", "OpenEXR", "onnx", "pxr"):
        monkeypatch.setitem(sys.modules, module, None)
    for arguments in (["a.ply", "--faces", "5"], ["d", "--format", "exr"], ["a.onnx"], ["a.usdc"]):
        error = fails([str(shells_asset), str(tmp_path / arguments[0]), *arguments[1:]], capsys)
        assert "pip install 'vfr-bake[export]'" in error
    assert not list(tmp_path.iterdir())


def test_views_and_sizes_are_python_s() -> None:
    assert [np.arange(9)[part(text)].tolist() for text in ("2", "-1", "::4", "7:")] == [
        [2], [8], [0, 4, 8], [7, 8]
    ]  # fmt: skip
    assert size("12X5") == (12, 5)
    for arguments in (["--size", "12"], ["--size", "0x4"], ["--views", "::0"], ["--frame", "unity"]):
        with pytest.raises(SystemExit) as leave:
            cli.main(["asset", "frames", "--format", "exr", *arguments])
        assert leave.value.code == 2


def test_options_of_every_format_are_checked() -> None:
    assert check_options(Path("x"), ExportOptions(format="exr", half=True)) == "exr"
    with pytest.raises(ConfigError, match="--decode does nothing for a ply mesh"):
        check_options(Path("x.ply"), ExportOptions(decode=True))
    with pytest.raises(ConfigError, match="--method: expected one of baked, density, tsdf, got marching"):
        check_options(Path("x.ply"), ExportOptions(method="marching"))  # type: ignore[arg-type]


@pytest.mark.parametrize("source", ["help", "docs"])
def test_examples_run(
    source: str, shells_asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every command in --help and docs/export.md runs, with files of the names that it uses."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(shells_asset, "out")
    Path("transforms_test.json").write_bytes((shells_asset / "cameras.json").read_bytes())
    matrix = np.eye(4)
    matrix[:3, 3] = 1.5, 2.375, 3.5
    Path("box.json").write_text(json.dumps({"matrix": matrix.tolist(), "size": [9, 9, 9]}))
    text = cli._EPILOG if source == "help" else (REPOSITORY / "docs/export.md").read_text(encoding="utf-8")
    lines = re.findall(r"^ *vfr-export (.*?)(?:   +.*|  # .*)?$", text, re.MULTILINE)
    assert len(lines) >= 10
    for line in lines:
        # the examples' boxes are for a scene around the origin
        line = re.sub(r"--crop [-\d.,]+", "--crop 1.5,2.375,3.5,9,9,9,30", line)
        # the asset's own mesh is a box far from its shells, where nothing has a colour
        line = line.replace("--texture 2048", "--texture 64 --method density --faces 2000")
        small = ["--size", "6x5", "--views", "0:2"] if "--format exr" in line else []
        assert cli.main([*shlex.split(line), *small, "--force"]) == 0, line
