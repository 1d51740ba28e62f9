"""Tests of `vfr-export` as a user calls it, on an asset whose mesh is known."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from exporters import cli, export
from exporters.formats.glb import parse_glb
from exporters.formats.ply import ply_bytes
from exporters.shapes.mesh import take_faces
from player.asset.asset import write_asset
from player.asset.bricks import pack_vertices
from player.asset.manifest import Manifest
from player.cameras.camera import Camera
from player.cameras.transforms import write_cameras
from tests.exporters.meshes import random_mesh, read_ply, sphere, tetrahedron
from tests.vertex_grids import arrays_of

# The asset's mesh is in the world frame already; an exporter that applied this again would be far off.
WORLD_FROM_MODEL = (
    (0.0, -2.0, 0.0, 10.0),
    (2.0, 0.0, 0.0, 20.0),
    (0.0, 0.0, 2.0, 30.0),
    (0.0, 0.0, 0.0, 1.0),
)


def write_small_asset(folder: Path, mesh: bytes) -> Path:
    """Write an asset of one stored cell, a head that is never opened, and `mesh`, as these tests need it."""
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    coords, masks, _ = pack_vertices(corners)
    codes, features = np.full(8, 200, np.uint8), np.zeros((8, 4), np.int8)
    arrays = arrays_of((coords, masks, codes), (coords, masks, features), (8, 8))
    manifest = Manifest(
        generator="tests",
        resolution=8,
        feature_resolution=8,
        step=0.25,
        density_range=(-2.0, 6.0),
        n_channels=4,
        view_size=(2, 2),
        world_from_model=WORLD_FROM_MODEL,
    )
    camera = Camera("a", np.eye(4), 2, 2, 1.0, 1.0, 1.0, 1.0)
    write_asset(folder, manifest, arrays, b"head", mesh, write_cameras([camera]))
    return folder


@pytest.fixture
def asset(tmp_path: Path) -> Path:
    return write_small_asset(tmp_path / "asset", ply_bytes(tetrahedron()))


def test_writes_world_coordinates(asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "mesh.ply"
    assert cli.main([str(asset), str(target), "--method", "baked"]) == 0
    mesh = read_ply(target)
    assert np.array_equal(mesh.vertices, tetrahedron().vertices)
    assert target.read_bytes() == (asset / "mesh.ply").read_bytes()
    assert np.array_equal(mesh.colours, tetrahedron().colours)
    output = capsys.readouterr()
    assert output.out.startswith(f"{target}: 4 vertices, 4 faces, ") and output.err == ""
    assert "bounds (0, 0, 0) to (1, 2, 3)" in output.out


@pytest.mark.needs("open3d")
def test_levels_of_detail_where_no_edge_can_be_collapsed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asset = write_small_asset(tmp_path / "asset", ply_bytes(random_mesh(60, 100)))
    asked = ["--method", "baked", "--lods", "3", "--json"]
    assert cli.main([str(asset), str(tmp_path / "mesh.ply"), *asked]) == 0
    faces = [level["faces"] for level in json.loads(capsys.readouterr().out)["lods"]]
    assert faces[0] == 100 and faces[1] <= 50 and 0 < faces[2] <= faces[1] // 2


@pytest.mark.needs("open3d")
def test_fewer_faces_than_a_closed_surface_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = write_small_asset(tmp_path / "asset", ply_bytes(sphere(20)))
    asked = [str(asset), str(tmp_path / "mesh.ply"), "--method", "baked", "--force", "--faces"]
    assert cli.main([*asked, "4"]) == 0
    assert "were asked for" not in capsys.readouterr().out
    assert cli.main([*asked, "1"]) == 0
    output = capsys.readouterr().out
    assert " 4 faces, " in output
    assert "1 were asked for, but fewer would leave nothing of the shape" in output


def test_glb_is_y_up_and_json_is_one_line(
    asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "MESH.GLB"
    assert cli.main([str(asset), str(target), "--method", "baked", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["file"] == str(target) and summary["format"] == "glb" and summary["faces"] == 4
    assert summary["bytes"] == target.stat().st_size
    document, _ = parse_glb(target.read_bytes(), "MESH.GLB")
    positions = document["accessors"][0]
    assert positions["min"] == [0, 0, -2] and positions["max"] == [1, 3, 0]
    assert summary["bounds"] == [[0, 0, 0], [1, 2, 3]]


def test_existing_target(asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "mesh.obj"
    target.write_text("mine")
    assert cli.main([str(asset), str(target)]) == 1
    assert target.read_text() == "mine"
    error = capsys.readouterr().err
    assert error == f"vfr-export: error: {target}: already exists: add --force to replace it\n"
    assert cli.main([str(asset), str(target), "--method", "baked", "--force"]) == 0
    assert target.read_text().startswith("# vfr-bake")


def test_unknown_suffix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([str(tmp_path), str(tmp_path / "mesh.fbx")]) == 1
    error = capsys.readouterr().err
    assert (
        "suffix: expected one of .ply, .obj, .glb, .stl, .usdc, .usda, .vdb, .npz, .json, .html, .onnx,"
        in error
    )
    assert error.endswith("or a folder with --format exr, colmap or web, got .fbx\n")
    assert cli.main([str(tmp_path), str(tmp_path / "mesh")]) == 1
    assert "got none" in capsys.readouterr().err


@pytest.mark.parametrize("damage", ["cut short", "changed", "no mesh"])
def test_damaged_mesh_leaves_nothing_behind(
    damage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mesh file that changed after the bake, or that never was a mesh, is refused and leaves no file."""
    data = ply_bytes(tetrahedron())
    asset = write_small_asset(tmp_path / "asset", data[:-1] if damage == "no mesh" else data)
    if damage == "cut short":
        (asset / "mesh.ply").write_bytes(data[:-1])
    elif damage == "changed":
        (asset / "mesh.ply").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    assert cli.main([str(asset), str(tmp_path / "mesh.glb"), "--method", "baked"]) == 1
    error = capsys.readouterr().err
    assert ("mesh.ply: sha256: expected" if damage == "changed" else "mesh.ply: size: expected") in error
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["asset"]


def test_a_stored_mesh_that_float32_has_deformed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An asset's mesh in the coordinates of a map is refused in every frame: it is stored in float32."""
    far = replace(tetrahedron(), vertices=tetrahedron().vertices + 4.5e6)
    asset = write_small_asset(tmp_path / "asset", ply_bytes(far))
    for frame in ("world", "model"):
        target = tmp_path / "mesh.obj"
        assert cli.main([str(asset), str(target), "--method", "baked", "--frame", frame]) == 1
        error = capsys.readouterr().err
        assert "mesh.ply: vertices: expected steps of float32 of at most 0.1 times the median edge" in error
        assert error.endswith("make the surface again, without --method baked\n")
        assert not target.exists()


@pytest.mark.parametrize("more", ["mesh.ply", "mesh.obj --lods 2", "mesh.stl --crop 0,0,0,1,1,1"])
def test_an_asset_without_a_mesh(more: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = write_small_asset(tmp_path / "asset", ply_bytes(take_faces(tetrahedron(), np.zeros(4, bool))))
    name, *words = more.split()
    assert cli.main([str(asset), str(tmp_path / name), *words, "--method", "baked"]) == 1
    error = capsys.readouterr().err
    assert error.endswith("mesh.ply: faces: expected a mesh, got none: leave out --method baked\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["asset"]


def test_bounds_far_from_the_origin(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The bounds that are printed are those from which a crop is chosen, in the coordinates of a map, too."""
    far = replace(tetrahedron(), vertices=tetrahedron().vertices + np.array([65536, 0, 0]))
    asset = write_small_asset(tmp_path / "asset", ply_bytes(far))
    assert cli.main([str(asset), str(tmp_path / "mesh.ply"), "--method", "baked"]) == 0
    assert "bounds (65536, 0, 0) to (65537, 2, 3)" in capsys.readouterr().out


def test_an_empty_folder_is_no_asset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert cli.main([str(tmp_path / "empty"), str(tmp_path / "mesh.glb")]) == 1
    assert f"{tmp_path / 'empty'}: " in capsys.readouterr().err


def test_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*arguments: object) -> dict:
        raise KeyboardInterrupt

    monkeypatch.setattr(export, "export_asset", interrupt)
    assert cli.main([str(tmp_path), "mesh.glb"]) == 130


def test_usage() -> None:
    with pytest.raises(SystemExit) as exit_info:
        cli.main(["--no-such-option"])
    assert exit_info.value.code == 2


def test_help_needs_no_numpy() -> None:
    """`--help` does not import numpy, which would take most of the start-up time."""
    program = "import sys; sys.modules['numpy'] = None; from exporters.cli import main; main(['--help'])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert all(name in done.stdout for name in (*cli.FORMATS, *cli.FOLDERS))
