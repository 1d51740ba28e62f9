"""`vfr-export` as a user calls it, on an asset whose mesh is known."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from exporters import cli
from exporters.glb import parse_glb
from exporters.ply import ply_bytes, read_ply
from player.asset import Asset
from tests.exporters.meshes import tetrahedron

# The model's frame is the world's halved, turned a quarter about z, and moved.
WORLD_FROM_MODEL = np.array([[0.0, -2, 0, 10], [2, 0, 0, 20], [0, 0, 2, 30], [0, 0, 0, 1]])


@pytest.fixture
def asset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The mesh of an asset and its manifest's matrix; the format itself is tested where it is defined."""
    folder = tmp_path / "asset"
    folder.mkdir()
    (folder / "mesh.ply").write_bytes(ply_bytes(tetrahedron()))
    opened = SimpleNamespace(
        path=lambda name: folder / name, manifest=SimpleNamespace(world_from_model=WORLD_FROM_MODEL.tolist())
    )
    monkeypatch.setattr(Asset, "open", lambda path, verify: opened)
    return folder


def test_writes_world_coordinates(asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "mesh.ply"
    assert cli.main([str(asset), str(target)]) == 0
    mesh = read_ply(target)
    np.testing.assert_allclose(
        mesh.vertices, [[10, 20, 30], [10, 22, 30], [6, 20, 30], [10, 20, 36]], atol=1e-6
    )
    assert np.array_equal(mesh.colours, tetrahedron().colours)
    output = capsys.readouterr()
    assert output.out.startswith(f"{target}: 4 vertices, 4 faces, ") and output.err == ""
    assert "bounds (6, 20, 30) to (10, 22, 36)" in output.out


def test_glb_is_y_up_and_json_is_one_line(
    asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "MESH.GLB"
    assert cli.main([str(asset), str(target), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["file"] == str(target) and summary["format"] == "glb" and summary["faces"] == 4
    assert summary["bytes"] == target.stat().st_size
    document, _ = parse_glb(target.read_bytes(), "MESH.GLB")
    assert document["accessors"][0]["min"] == [6, 30, -22] and document["accessors"][0]["max"] == [
        10,
        36,
        -20,
    ]


def test_existing_target(asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "mesh.obj"
    target.write_text("mine")
    assert cli.main([str(asset), str(target)]) == 1
    assert target.read_text() == "mine"
    error = capsys.readouterr().err
    assert error == f"vfr-export: error: {target}: already exists: add --force to replace it\n"
    assert cli.main([str(asset), str(target), "--force"]) == 0
    assert target.read_text().startswith("# vfr-bake")


def test_unknown_suffix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([str(tmp_path), str(tmp_path / "mesh.fbx")]) == 1
    assert "suffix: expected one of .ply, .obj, .glb, got .fbx" in capsys.readouterr().err
    assert cli.main([str(tmp_path), str(tmp_path / "mesh")]) == 1
    assert "got none" in capsys.readouterr().err


def test_damaged_mesh_leaves_nothing_behind(
    asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (asset / "mesh.ply").write_bytes(ply_bytes(tetrahedron())[:-1])
    assert cli.main([str(asset), str(tmp_path / "mesh.glb")]) == 1
    error = capsys.readouterr().err
    assert "mesh.ply: size: expected" in error and error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["asset"]


def test_an_empty_folder_is_no_asset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([str(tmp_path), str(tmp_path / "mesh.glb")]) == 1
    assert str(tmp_path) in capsys.readouterr().err


def test_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*arguments: object) -> dict:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "export_mesh", interrupt)
    assert cli.main([str(tmp_path), "mesh.glb"]) == 130


def test_usage() -> None:
    with pytest.raises(SystemExit) as exit_info:
        cli.main(["--no-such-option"])
    assert exit_info.value.code == 2


def test_help_needs_no_numpy() -> None:
    """So it is quick: importing numpy is most of what a start costs."""
    program = "import sys; sys.modules['numpy'] = None; from exporters.cli import main; main(['--help'])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert all(suffix in done.stdout for suffix in cli.FORMATS)
