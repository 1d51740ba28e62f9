"""`vfr-bake --convert`: the same values and pictures, in the current version of the format."""

from __future__ import annotations

import hashlib
import json
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from exporters.formats.ply import parse_ply, ply_bytes
from exporters.shapes.mesh import TriangleMesh
from player.asset.asset import Asset
from player.asset.pyramid import coarser
from player.cameras.views import asset_cameras
from player.render import Renderer
from tests.version_3 import as_version_3
from vfr_bake.baking.limits import file_sizes
from vfr_bake.cli import bake_main


@pytest.fixture
def old(shells_folder: Path, tmp_path: Path) -> Path:
    """The small asset of the tests in version 3.1, with a report, and a mesh as that version has it."""
    folder = as_version_3(Path(shutil.copytree(shells_folder, tmp_path / "old")))
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    mesh = ply_bytes(
        TriangleMesh(np.eye(3), np.arange(3, dtype=np.int32)[None], up, np.full((3, 4), 255, np.uint8))
    )
    document = json.loads((folder / "manifest.json").read_text())
    for name, data in (("report.json", b"{}"), ("mesh.ply", mesh)):
        (folder / name).write_bytes(data)
        document["files"][name] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (folder / "manifest.json").write_text(json.dumps(document))
    return folder


def test_the_finest_level_and_every_other_file_stay(
    old: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = tmp_path / "new"
    assert bake_main(["--convert", str(old), str(new), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["version_before"] == [3, 1]
    for folder, told_mb in ((old, told["megabytes_before"]), (new, told["megabytes"])):
        assert told_mb == sum(file_sizes(folder).values()) / 1e6, "as a bake counts: without the report"
    one, other = Asset.open(old, verify=True), Asset.open(new, verify=True)
    assert other.manifest.version == (4, 0) and len(other.manifest.parts) > 1
    for grid in ("densities", "features"):
        before, after = getattr(one.arrays, grid), getattr(other.arrays, grid)
        assert np.array_equal(before.values[0], after.values[0])
        levels = after.pyramid.levels
        assert len(levels) == 3 and after.pyramid.cells_per_axis(2) == 16
        for fine, coarse in pairwise(levels):
            assert np.array_equal(coarser(fine).masks, coarse.masks)
        for fine, coarse in ((0, 1), (1, 2)):
            vertices = after.pyramid.vertices
            rows = vertices[fine].rows(vertices[coarse].index * 2)
            assert np.array_equal(after.values[fine][rows[rows >= 0]], after.values[coarse][rows >= 0])
    for name in ("head.onnx", "cameras.json", "report.json"):
        assert one.read(name) == other.read(name)
    keys = ("generator", "aabb", "step", "n_fetches", "density_range", "background", "provenance", "near")
    assert all(getattr(one.manifest, key) == getattr(other.manifest, key) for key in keys)
    camera = asset_cameras(one)[0]
    with Renderer(one, 1, "numpy") as a, Renderer(other, 1, "numpy") as b:
        x, y = a.render(camera), b.render(camera)
    assert np.array_equal(x.opacity, y.opacity)
    # where no fine brick is, a fetch between two surfaces reads a coarser brick that reaches that far
    assert np.square(x.rgb - y.rgb).mean() < 1e-5 and np.abs(x.rgb - y.rgb).max() < 0.1


def test_the_mesh_becomes_as_small_as_a_baked_one(old: Path, tmp_path: Path) -> None:
    assert bake_main(["--convert", str(old), str(tmp_path / "new")]) == 0
    before, after = ((folder / "mesh.ply").read_bytes() for folder in (old, tmp_path / "new"))
    assert b"property float nx" in before and b"property uchar alpha" in before
    header = after[: after.index(b"end_header")]
    assert b"nx" not in header and b"alpha" not in header
    assert len(parse_ply(after, "mesh.ply").faces)
    assert len(after) <= 0.1 * sum(file_sizes(tmp_path / "new").values())


def test_converting_again_changes_nothing(old: Path, tmp_path: Path) -> None:
    for before, after in ((old, "a"), (tmp_path / "a", "b")):
        assert bake_main(["--convert", str(before), str(tmp_path / after)]) == 0
    for path in (tmp_path / "a").iterdir():
        assert (tmp_path / "b" / path.name).read_bytes() == path.read_bytes(), path.name


def test_what_cannot_be_converted(old: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new = tmp_path / "new"
    new.mkdir()
    (new / "manifest.json").write_text('{"format": "vfr-asset"}')
    assert bake_main(["--convert", str(old), str(new)]) == 1
    assert "new: already exists: add --force" in capsys.readouterr().err
    assert bake_main(["--convert", str(old), str(new), "--force", "--preset", "fast"]) == 1
    assert "--convert: expected no other setting than --max-memory, got ['preset']" in capsys.readouterr().err
    assert bake_main(["--convert", str(tmp_path / "none"), str(tmp_path / "x")]) == 1
    assert "expected the folder of an asset, got nothing" in capsys.readouterr().err
    (old / "features.codes").write_bytes(b"short")
    assert bake_main(["--convert", str(old), str(new), "--force"]) == 1
    assert "features.codes: size: expected" in capsys.readouterr().err
    assert [path.name for path in new.iterdir()] == ["manifest.json"]


def test_the_help_says_what_it_is_for(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        bake_main(["--help"])
    assert "vfr-bake --convert old/ new/" in " ".join(capsys.readouterr().out.split())
