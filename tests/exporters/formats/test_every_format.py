"""Tests of every format: equal bytes every time, comparison with the source, and no half-written files."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenEXR
import pytest

from exporters import cli
from exporters import options as formats
from exporters.formats import colmap, exr, glb, npz, obj, ply, points, stl, usd, vdb
from exporters.formats import transforms as cameras
from exporters.head import asset_head
from exporters.shapes.mesh import TriangleMesh
from exporters.shapes.volume import Volume
from player.asset.asset import Asset
from player.cameras.camera import Camera
from tests.exporters.test_export import fails

WAYS = {
    "ply": "a.ply",
    "baked": "a.ply --method baked",
    "obj": "a.obj",
    "glb": "a.glb",
    "stl": "a.stl",
    "usdc": "a.usdc",
    "usda": "a.usda",
    "points": "a.ply --points 40",
    "density": "a.ply --method density",
    "tsdf": "a.ply --method tsdf",
    "simplified": "a.ply --level 20 --faces 900 --lods 2",
    "textured glb": "a.glb --level 20 --faces 500 --texture 64",
    "textured obj": "a.obj --level 20 --faces 500 --texture 64",
    "vdb": "a.vdb --colour",
    "npz": "a.npz --colour",
    "json": "a.json",
    "onnx": "a.onnx",
    "onnx with the decode": "a.onnx --decode",
    "colmap": "a --format colmap --points 40",
    "html": "a.html",
    "web": "a --format web",
    "exr": "a --format exr --views 0:2 --size 6x5",
}


def call(asset: Asset, folder: Path, way: str, *more: str) -> list[str]:
    name, *words = shlex.split(WAYS[way])
    return [str(asset.folder), str(folder / name), *words, *more]


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_no_format_is_left_out() -> None:
    suffixes = {Path(shlex.split(words)[0]).suffix for words in WAYS.values()}
    assert suffixes - {""} == set(formats.FORMATS)
    assert set(formats.FOLDERS) <= set(WAYS)


@pytest.mark.parametrize("way", WAYS)
def test_the_same_bytes_again(way: str, cube_asset: Asset, tmp_path: Path) -> None:
    for folder in ("one", "two"):
        assert cli.main(call(cube_asset, tmp_path / folder, way)) == 0
    one = content(tmp_path / "one")
    assert one and one == content(tmp_path / "two")


OLD = {
    "colmap": {"images.bin": "\1" + "\0" * 7 + "\1" + "\0" * 63 + "old.png" + "\0" * 9},
    "exr": {"old.exr": "v/1\x01 old software\0string\0\x0a\0\0\0vfr-export"},
    "web": {"manifest.json": '{"format": "vfr-asset", "generator": "old"}', "main.js": "old"},
}
"""Files that a folder of each format may hold after an earlier export."""


@pytest.mark.parametrize("way", WAYS)
def test_the_old_stays_until_the_new_is_complete(
    way: str,
    cube_asset: Asset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """An old file stays as it was if the last step, the renaming of the new file, fails."""
    target = Path(call(cube_asset, tmp_path, way)[1])
    if target.suffix:
        target.write_text("old")
    else:
        target.mkdir()
        for name, text in OLD[way].items():
            (target / name).write_text(text)
    before = content(tmp_path)

    def full(self: Path, other: Path) -> Path:
        raise OSError(28, "No space left on device")

    for name in ("replace", "rename"):
        monkeypatch.setattr(Path, name, full)
    monkeypatch.setattr("player.files.replace.exchange", lambda *_: False)
    error = fails(call(cube_asset, tmp_path, way, "--force"), capsys)
    assert error.endswith(": cannot write: No space left on device\n") and str(tmp_path) in error
    assert content(tmp_path) == before
    monkeypatch.undo()
    assert cli.main(call(cube_asset, tmp_path, way, "--force")) == 0
    assert not set(before.values()) & set(content(tmp_path).values())


def moved(mesh: TriangleMesh) -> TriangleMesh:
    """Return the mesh with one corner moved by a thousandth."""
    vertices = mesh.vertices.astype(np.float64)
    vertices[mesh.faces[0, 0] if len(mesh.faces) else 0] += [0, 0, 1e-3]
    return replace(mesh, vertices=vertices)


def denser(volume: Volume) -> Volume:
    """Return the volume with the density of one voxel raised by a thousandth."""
    density = volume.density.copy()
    density[5] *= np.float32(1.001)
    return replace(volume, density=density)


def nearer(camera: Camera) -> Camera:
    c2w = camera.c2w.copy()
    c2w[2, 3] += 1e-3
    return replace(camera, c2w=c2w)


def with_first(change: Callable[[Any], Any], original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda first, *rest: original(change(first), *rest)


def damage(way: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Make a format's writer write something other than it is given; return what the message must name."""
    meshes = {
        "obj": (obj, "obj_bytes"),
        "glb": (glb, "glb_bytes"),
        "stl": (stl, "stl_bytes"),
        "usdc": (usd, "usd_bytes"),
        "usda": (usd, "usd_bytes"),
        "points": (points, "points_bytes"),
        "textured glb": (glb, "glb_bytes"),
        "textured obj": (obj, "textured_obj_files"),
    }
    volumes = {"vdb": (vdb, "vdb_bytes"), "npz": (npz, "npz_bytes")}
    if way in volumes:
        module, name = volumes[way]
        monkeypatch.setattr(module, name, with_first(denser, getattr(module, name)))
        return "density: number"
    if way == "json":
        write = cameras.write_cameras
        monkeypatch.setattr(cameras, "write_cameras", lambda views: write([nearer(views[0]), *views[1:]]))
        return "pose: 0.001 apart"
    if way == "colmap":
        monkeypatch.setattr(colmap, "quaternion", lambda rotation: np.array([1.0, 0, 0, 0]))
        return "apart, tolerance"
    if way.startswith("onnx"):
        shade = asset_head.Head.__call__
        monkeypatch.setattr(asset_head.Head, "__call__", lambda *given: shade(*given) + np.float32(0.01))
        return "rgb, one pixel: pixel 0"
    page = import_module("player.page.page")  # by name, because its package has a function `page`
    if way == "html":
        text = page.text_of_bytes

        def other(data: bytes) -> bytes:
            return text(data[:-1] + bytes([data[-1] ^ 1]) if data else data)

        monkeypatch.setattr(page, "text_of_bytes", other)
        return "cameras.json: expected sha256"
    if way == "web":
        data = page.scene_files
        monkeypatch.setattr(page, "scene_files", lambda asset: {**data(asset), "part_0.bin": b"other"})
        return "part_0.bin: expected sha256"
    if way == "exr":

        def file(first: Any, *rest: Any, **more: Any) -> Any:
            if rest:
                rest[0]["Z"] = rest[0]["Z"] + np.float32(1)
                rest[0]["Z"][0, 0] = 7
            return OpenEXR.File(first, *rest, **more)

        known = {name: getattr(OpenEXR, name) for name in ("ZIP_COMPRESSION", "scanlineimage")}
        monkeypatch.setattr(exr, "load_openexr", lambda: SimpleNamespace(File=file, **known))
        return "Z: expected"
    module, name = meshes.get(way, (ply, "ply_bytes"))
    monkeypatch.setattr(module, name, with_first(moved, getattr(module, name)))
    return {"points": "points: number", "stl": "corners: number"}.get(way, "vertices: number")


@pytest.mark.parametrize("way", WAYS)
def test_what_differs_from_its_source_is_not_written(
    way: str,
    cube_asset: Asset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    named = damage(way, monkeypatch)
    assert named in fails(call(cube_asset, tmp_path, way), capsys)
    assert not list(tmp_path.iterdir())
