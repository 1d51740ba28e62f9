"""Tests of `vfr-export` as a user calls it: surfaces of the field, textures and levels of detail."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from exporters import cli, export, export_mesh
from player.asset.asset import Asset
from player.errors import OutputError
from player.files.files import write_together
from tests.exporters.conftest import CUBE_HIGH, CUBE_LOW
from tests.exporters.meshes import read_ply, sphere
from tests.exporters.solids import WORLD_FROM_MODEL, offset_of
from tests.exporters.test_export import fails


def world_box(level: float) -> np.ndarray:
    """Return the bounds [2, 3], world frame, of the surface of the asset's box at a level of density."""
    offset = offset_of(level, 48)
    corners = np.array([np.array(CUBE_LOW) - offset, np.array(CUBE_HIGH) + offset])
    matrix = np.array(WORLD_FROM_MODEL)
    moved = corners @ matrix[:3, :3].T + matrix[:3, 3]
    return np.array([moved.min(0), moved.max(0)])


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb", "stl"])
def test_a_box_comes_back_at_its_place_in_its_size(suffix: str, cube_asset: Asset, tmp_path: Path) -> None:
    target = tmp_path / f"box.{suffix}"
    assert cli.main([str(cube_asset.folder), str(target), "--level", "20"]) == 0
    read = trimesh.load_mesh(target, process=False)
    bounds = read.bounds if suffix != "glb" else (read.vertices[:, [0, 2, 1]] * [1, -1, 1])[:, :]
    bounds = np.array([bounds.min(0), bounds.max(0)])
    np.testing.assert_allclose(bounds, world_box(20), rtol=0, atol=0.1 * 4 / 48)


def test_what_was_removed_is_said(
    cube_asset: Asset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "a.ply"
    arguments = [str(cube_asset.folder), str(target), "--method", "density"]
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert "faces that no training camera sees, 0 of haze and 0 floating parts (0 faces) removed" in out
    assert cli.main([*arguments, "--force", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    told = re.search(r"(\d+) faces that no training camera sees, (\d+) of haze", out)
    assert told and summary["method"] == "density"
    assert [summary["unseen_faces_removed"], summary["haze_faces_removed"]] == [int(n) for n in told.groups()]
    assert summary["floaters_removed"] == summary["floater_faces_removed"] == 0


def test_levels_of_detail(cube_asset: Asset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "a.ply"
    arguments = [str(cube_asset.folder), str(target), *shlex.split("--level 20 --faces 4000 --lods 3 --json")]
    assert cli.main(arguments) == 0
    summary = json.loads(capsys.readouterr().out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.lod1.ply", "a.lod2.ply", "a.ply"]
    for number, (level, name) in enumerate(
        zip(summary["lods"], ["a.ply", "a.lod1.ply", "a.lod2.ply"], strict=True)
    ):
        mesh = read_ply(tmp_path / name)
        assert Path(level["file"]).name == name and level["faces"] == len(mesh.faces) <= 4000 / 2**number
        np.testing.assert_allclose(mesh.bounds, world_box(20), rtol=0, atol=0.2 * 4 / 48)
        assert mesh.colours[:, :3].std(axis=0).min() > 3  # colours are kept
    assert summary["bytes"] == sum(path.stat().st_size for path in tmp_path.iterdir())
    first = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert cli.main([*arguments, "--force"]) == 0
    assert first == {path.name: path.read_bytes() for path in tmp_path.iterdir()}


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_a_texture_has_the_vertex_colours_of_the_surface(
    suffix: str, cube_asset: Asset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A texture has about the colours of the same surface's vertices. They differ by directions only: a
    vertex fits what all cameras see, a texel is the mean of four cameras, and the head's colours change with
    the direction by up to 60 levels."""
    target = tmp_path / f"a.{suffix}"
    asked = shlex.split("--level 20 --faces 1500 --texture 256")
    assert cli.main([str(cube_asset.folder), str(target), *asked]) == 0
    said = capsys.readouterr().out
    names = {"glb": ["a.glb"], "obj": ["a.mtl", "a.obj", "a.png"]}[suffix]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert cli.main([str(cube_asset.folder), str(tmp_path / "a.ply"), "--level", "20"]) == 0
    read = trimesh.load_mesh(target, process=False)
    assert f": {len(read.vertices)} vertices, {len(read.faces)} faces, " in said
    places = read.vertices if suffix == "obj" else read.vertices[:, [0, 2, 1]] * [1, -1, 1]
    plain = read_ply(tmp_path / "a.ply")
    nearest = np.array([np.abs(plain.vertices - place).sum(-1).argmin() for place in places])
    got = np.asarray(read.visual.to_color().vertex_colors)[:, :3].astype(int)
    apart = np.abs(got - plain.colours[nearest, :3])
    assert np.median(apart) <= 6 and np.percentile(apart, 95) <= 25
    before = {name: (tmp_path / name).read_bytes() for name in names}
    assert cli.main([str(cube_asset.folder), str(target), *asked, "--force"]) == 0
    assert before == {name: (tmp_path / name).read_bytes() for name in names}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("a.ply --level 1e9", "--level: expected a density between"),
        ("a.ply --level 0", "--level: expected a density between"),
        ("a.ply --level 5 --method tsdf", "--level: expected --method density, got tsdf"),
        ("a.ply --level 5 --method baked", "--level: expected --method density, got baked"),
        ("a.ply --level 20 --crop 90,9,9,1,1,1", "--crop: expected a box with some of the mesh in it"),
        ("a.ply --lods 1", "--lods: expected 2 to 10, got 1"),
        ("a.glb --texture 8", "--texture: expected 16 to 8192, got 8"),
        ("a.glb --texture 8193", "--texture: expected 16 to 8192, got 8193"),
        ("a.ply --texture 64", "--texture does nothing for a ply mesh; it takes --crop, --faces, --frame"),
        ("a.glb --time-limit 5", "--time-limit: expected it with --texture, got it alone"),
        ("a.glb --texture 64 --time-limit 0", "--time-limit: expected seconds > 0, got 0"),
        ("a.glb --texture 64 --time-limit 0.001", "--texture: laying out"),
        ("a b.obj --texture 64", "OBJ: name: expected one without spaces"),
        ("x.png --format obj --texture 64", "x.png: name: expected another than those of the MTL and"),
        ("x --format obj --texture 64 --lods 2", "x: name: expected another than those of the MTL and"),
        ("a.json --method tsdf", "--method does nothing for json"),
    ],
)
def test_one_line_and_nothing_written(
    arguments: str, message: str, cube_asset: Asset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *more = arguments.split(" --")
    words = [word for part in more for word in shlex.split(f"--{part}")]
    assert message in fails([str(cube_asset.folder), str(tmp_path / name), *words], capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("'a b.obj' --texture 64", "OBJ: name: expected one without spaces"),
        ("a.glb --texture 64", "--texture: needs xatlas: pip install 'vfr-bake[export]'"),
        ("a.usdc", "USD: needs usd-core: pip install 'vfr-bake[export]'"),
        ("a.ply --faces 9", "--faces: needs open3d: pip install 'vfr-bake[export]'"),
        ("a.ply --lods 2", "--lods: needs open3d: pip install 'vfr-bake[export]'"),
        ("a.ply --method tsdf", "--method tsdf: needs open3d: pip install 'vfr-bake[export]'"),
        ("a --format colmap --method tsdf", "--method tsdf: needs open3d"),
    ],
)
def test_what_the_last_step_would_refuse_is_refused_before_the_asset_is_opened(
    arguments: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for module in ("open3d", "pxr"):
        monkeypatch.setitem(sys.modules, module, None)
    name, *more = shlex.split(arguments)
    assert message in fails([str(tmp_path / "no asset"), str(tmp_path / name), *more], capsys)


@pytest.mark.parametrize("arguments", ["a.ply", "a.glb", "a.stl", "a.usdc", "a.ply --points 9"])
def test_coordinates_that_float32_cannot_hold(
    arguments: str,
    cube_asset: Asset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A mesh in the coordinates of a map is refused in one line; an OBJ has digits enough."""
    mesh = sphere(20)
    far = replace(mesh, vertices=mesh.vertices + np.array([4.5e6, 5e5, 300.0]))
    for module in (export, export_mesh):
        monkeypatch.setattr(module, "world_mesh", lambda *_: (far, {"frame": "world"}))
    name, *more = shlex.split(arguments)
    error = fails([str(cube_asset.folder), str(tmp_path / name), *more], capsys)
    assert f"{name}: vertices: expected steps of float32" in error and "add --frame model" in error
    assert not list(tmp_path.iterdir())
    assert cli.main([str(cube_asset.folder), str(tmp_path / "a.obj")]) == 0


def test_files_beside_the_target_are_not_overwritten(
    cube_asset: Asset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for other, more in (("a.png", "--texture 64"), ("a.lod1.obj", "--lods 2")):
        (tmp_path / other).write_text("mine")
        error = fails([str(cube_asset.folder), str(tmp_path / "a.obj"), *shlex.split(more)], capsys)
        assert f"{other}: already exists: add --force" in error
        assert [path.name for path in tmp_path.iterdir()] == [other]
        (tmp_path / other).unlink()


def test_together_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.obj").write_text("old")
    written = []

    def fsync(handle: int) -> None:
        written.append(handle)
        if len(written) == 2:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(OutputError, match=r"a\.obj: cannot write: No space left on device"):
        write_together({tmp_path / "a.obj": b"1", tmp_path / "a.mtl": b"2"})
    assert [path.name for path in tmp_path.iterdir()] == ["a.obj"] and (
        tmp_path / "a.obj"
    ).read_text() == "old"
    monkeypatch.undo()
    write_together({tmp_path / "a.obj": b"1", tmp_path / "a.mtl": b"2"})
    assert (tmp_path / "a.obj").read_bytes() == b"1" and (tmp_path / "a.mtl").read_bytes() == b"2"
