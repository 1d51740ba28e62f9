"""Tests of volumes: what the numbers in an NPZ and a VDB mean, and the comparison before writing."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from exporters import cli, export
from exporters.formats import vdb
from exporters.formats.npz import npz_bytes, parse_npz
from exporters.formats.parity import check_volume_bytes
from exporters.formats.vdb import parse_vdb, vdb_bytes
from exporters.options import ExportOptions
from exporters.shapes.colour import linear_from_srgb
from exporters.shapes.volume import Volume, _slope, asset_volume
from player.asset.asset import Asset
from player.asset.bricks import pack_vertices
from player.asset.single_level import VertexBricks, from_vertices
from player.errors import ConfigError, FormatError, ParityError, ShapeError
from tests.exporters.formats import block
from tests.player import conftest as shells
from tests.vertex_grids import grid_of


def some_volume(n: int = 900, colour: bool = True) -> Volume:
    """Return a volume of voxels in random order, spread over several inner nodes of the VDB tree."""
    random = np.random.default_rng(3)
    index = np.unique(random.integers(0, 700, (n, 3)), axis=0).astype(np.int32)
    random.shuffle(index)
    rgb = random.integers(0, 256, (len(index), 3)).astype(np.uint8) if colour else None
    density = random.random(len(index)).astype(np.float32) + 0.1
    return Volume(index, density, rgb, np.array(shells.WORLD_FROM_MODEL))


@pytest.fixture(scope="module")
def block_asset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return block.write_block(tmp_path_factory.mktemp("block") / "asset")


def test_the_block_is_at_its_place_with_its_density(block_asset: Path, tmp_path: Path) -> None:
    """The block is exported with its place and density in world units, though the asset stores the density
    per model unit, which is two world units."""
    path = tmp_path / "a.npz"
    summary = export.export_asset(block_asset, path, ExportOptions(colour=True))
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    info = json.loads(str(arrays["info"]))
    places = arrays["index"] @ arrays["matrix"][:3, :3].T + arrays["matrix"][:3, 3]
    np.testing.assert_allclose([places.min(0), places.max(0)], block.BOUNDS, atol=1e-12)
    np.testing.assert_allclose(summary["bounds"], block.BOUNDS, atol=1e-12)
    # half a quantization step of the 8-bit logarithm, (6 - -2) / 255 / 2
    np.testing.assert_allclose(arrays["density"], block.SIGMA, rtol=0.016)
    assert info["voxel"] == pytest.approx(1 / 16) and info["level"] == pytest.approx(np.log(2) * 16)
    assert info["frame"] == "world" and info["unit"] == "1/world unit" and info["colour_space"] == "srgb"
    assert summary["voxels"] == len(places) == np.prod(block.HIGH - block.LOW + 1)
    # the features are exact integers: only the rounding of colours to bytes differs
    np.testing.assert_allclose(arrays["colour"] / 255, block.colours(arrays["index"]), atol=0.51 / 255)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("rise", [(1, 0, 0), (0, -2, 0), (3, 2, -1)])
def test_colours_are_looked_at_up_the_density(size: float, rise: tuple[int, int, int]) -> None:
    """Directions follow the gradient of linear codes in model units, in a box of three different edges and
    of any size, and point down where the codes are constant."""
    vertices = np.argwhere(np.ones((9, 9, 9)))
    coords, masks, order = pack_vertices(vertices)
    vertices = vertices[order]
    codes = (vertices @ np.array(rise) + 100).astype(np.uint8)
    edges = np.array([2.0, 3.0, 5.0]) * size
    where, features = (coords, masks), np.zeros((len(codes), 1), np.int8)
    grid = grid_of(
        (*where, codes), (*where, features), (8, 8), np.stack([0 * edges, edges]), 0.1 * size, (0.0, 1.0)
    )
    rows = from_vertices(VertexBricks(*where, codes), 8).pyramid.vertices[0]
    inner = np.argwhere(np.ones((7, 7, 7))) + 1
    wanted = np.array(rise) / edges
    np.testing.assert_allclose(
        _slope(grid, rows, codes, inner),
        np.tile(wanted / np.linalg.norm(wanted), (343, 1)),
        rtol=0,
        atol=1e-6,
    )
    assert (_slope(grid, rows, np.full_like(codes, 7), inner) == [0, 0, -1]).all()


def test_dense_as_the_docstring_says(block_asset: Path) -> None:
    volume, _ = asset_volume(Asset.open(block_asset), np.eye(4))
    grid = np.zeros(volume.index.max(0) + 1, np.float32)
    grid[tuple(volume.index.T)] = volume.density
    assert (grid[20:37, 16:41, 24:57] > 19).all() and np.count_nonzero(grid) == 17 * 25 * 33


def test_density_scales_with_the_frame(block_asset: Path, tmp_path: Path) -> None:
    """The optical depth of a voxel (density times length) is the same in every frame."""
    for frame, length in (("world", 1 / 16), ("model", 1 / 32), ("gltf", 1 / 16), ("blender", 1 / 16)):
        path = tmp_path / f"{frame}.npz"
        export.export_asset(block_asset, path, ExportOptions(frame=frame))  # type: ignore[arg-type]
        volume = parse_npz(path.read_bytes(), "a.npz")
        assert volume.voxel == pytest.approx(length)
        np.testing.assert_allclose(volume.density * length, block.SIGMA / 16, rtol=0.016)
    low, high = parse_npz((tmp_path / "gltf.npz").read_bytes(), "").points()[[0, -1]]
    (x0, y0, z0), (x1, y1, z1) = block.BOUNDS
    np.testing.assert_allclose(np.sort([low, high], axis=0), [[x0, z0, -y1], [x1, z1, -y0]], atol=1e-12)


def test_blender_s_half_voxel(block_asset: Path, tmp_path: Path) -> None:
    grids = {}
    for frame in ("world", "blender"):
        export.export_asset(block_asset, tmp_path / f"{frame}.vdb", ExportOptions(frame=frame))  # type: ignore[arg-type]
        grids[frame] = parse_vdb((tmp_path / f"{frame}.vdb").read_bytes(), "")["density"]
    world, blender = grids["world"].matrix, grids["blender"].matrix
    np.testing.assert_allclose(world @ [20, 16, 24, 1], blender @ [20.5, 16.5, 24.5, 1], atol=1e-12)


def test_colours_look_down_the_slope(opened: Asset) -> None:
    """Colours of a shell's outer side are those seen looking inwards, and of its inner side outwards. The
    asset's head depends on the direction, so a wrong sign or axis would give another colour."""
    volume, _ = asset_volume(opened, np.eye(4), colour=True)
    place = volume.index / shells.RESOLUTION * 2 - 1
    radius = np.linalg.norm(place, axis=-1)
    chosen = (radius > 0.51) & (radius < 0.53)  # outside the inner shell, both neighbours stored
    expected = _sigmoid_head(opened, np.flatnonzero(chosen), -place[chosen] / radius[chosen, None])
    got = volume.colours
    assert got is not None and chosen.sum() > 500
    # the slope is a central difference of rounded codes, some degrees off the radius
    assert np.abs(got[chosen] / 255 - expected).mean() < 0.01
    wrong = _sigmoid_head(opened, np.flatnonzero(chosen), place[chosen] / radius[chosen, None])
    assert np.abs(got[chosen] / 255 - wrong).mean() > 0.05


def _sigmoid_head(asset: Asset, rows: np.ndarray, dirs: np.ndarray) -> np.ndarray:
    from player.head.head import Head

    features = asset.arrays.features.values[0][rows].astype(np.float32)
    return Head.of(asset)(features, dirs.astype(np.float32))


def test_vdb_holds_every_number_and_the_same_bytes_again() -> None:
    volume = some_volume()
    data = vdb_bytes(volume)
    assert data == vdb_bytes(volume)
    shuffled = np.random.default_rng(0).permutation(len(volume.index))
    other = replace(volume, index=volume.index[shuffled], density=volume.density[shuffled],
                    colours=volume.colours[shuffled])  # type: ignore[index]  # fmt: skip
    assert data == vdb_bytes(other), "the order of the rows is not part of a volume"
    grids = parse_vdb(data, "a.vdb")
    assert list(grids) == ["density", "color"]
    found = {
        tuple(i): d for i, d in zip(grids["density"].index.tolist(), grids["density"].values, strict=True)
    }
    assert all(found[tuple(i)] == d for i, d in zip(volume.index.tolist(), volume.density, strict=True))
    assert volume.colours is not None and np.array_equal(grids["density"].matrix, volume.matrix)
    first = grids["color"].index.tolist().index(volume.index[0].tolist())
    np.testing.assert_allclose(
        grids["color"].values[first], linear_from_srgb(volume.colours[0] / 255), atol=6e-8
    )


@pytest.mark.parametrize("corner", [(0, 0, 0), (7, 7, 7), (8, 127, 128), (2048, 2048, 2048), (4095, 0, 4095)])
def test_one_voxel_anywhere(corner: tuple[int, int, int]) -> None:
    volume = Volume(np.array([corner], np.int32), np.ones(1, np.float32), None, np.eye(4))
    assert parse_vdb(vdb_bytes(volume), "")["density"].index.tolist() == [list(corner)]


@pytest.mark.parametrize("suffix", [".vdb", ".npz"])
def test_parity_names_the_worst(suffix: str) -> None:
    volume = some_volume()

    def data(changed: Volume) -> bytes:
        return vdb_bytes(changed) if suffix == ".vdb" else npz_bytes(changed, "world")

    check_volume_bytes(suffix, data(volume), volume, "a")
    density, index = volume.density.copy(), volume.index.copy()
    density[5] = 99
    index[7] = 699
    colours = np.array(volume.colours)
    colours[3, 1] ^= 1
    for changed, what in (
        (replace(volume, density=density), "a: density: number"),
        (replace(volume, index=index), "a: vertices: number"),
        (replace(volume, colours=colours), "a: color: number"),
        (replace(volume, colours=None), r"a: grids: expected \['color', 'density'\], got \['density'\]"),
        (replace(volume, matrix=np.eye(4)), "a: matrix: number"),
        (some_volume(20), "a: vertices: expected"),
    ):
        with pytest.raises(ParityError, match=what):
            check_volume_bytes(suffix, data(changed), volume, "a")


def test_damaged_files() -> None:
    data = vdb_bytes(some_volume(50))
    for broken in (data[:-1], data + b"\0", data[:200], b"", b"x" * 300, data.replace(b"Affine", b"Affinx")):
        with pytest.raises(FormatError, match=r"a\.vdb: expected a VDB as `vfr-export` writes it"):
            parse_vdb(broken, "a.vdb")
    file = io.BytesIO()
    np.savez(file, index=np.zeros((1, 3), np.int32))
    for broken in (b"", b"PK\3\4", npz_bytes(some_volume(50), "world")[:-30], file.getvalue()):
        with pytest.raises(FormatError, match=r"a\.npz: expected a volume"):
            parse_npz(broken, "a.npz")


def test_bad_volumes() -> None:
    empty = Volume(np.zeros((0, 3), np.int32), np.zeros(0, np.float32), None, np.eye(4))
    far = Volume(np.array([[4096, 0, 0]], np.int32), np.ones(1, np.float32), None, np.eye(4))
    for volume, got in ((empty, "0 up to 0"), (far, "1 up to 4096")):
        said = f"VDB: volume: expected 1 or more vertices with indices below 4096, got {got}"
        with pytest.raises(ConfigError, match=said):
            vdb_bytes(volume)
    with pytest.raises(ShapeError, match=r"volume: density: expected \[1\], got \[2\]"):
        Volume(np.zeros((1, 3), np.int32), np.zeros(2, np.float32), None, np.eye(4))


def test_colours_are_a_voxel_wider_at_the_edge_of_the_grid_too(
    block_asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vertices with an index of 0 get a colour before them; places, densities and colours stay."""
    index = np.array([[0, 3, 9], [1, 3, 9]], np.int32)
    matrix = np.diag([0.5, 2, 1, 1])
    volume = Volume(index, np.array([3, 4], np.float32), np.full((2, 3), 128, np.uint8), matrix)
    monkeypatch.setattr(export, "asset_volume", lambda *_: (volume, 0.0))
    export.export_asset(block_asset, tmp_path / "a.vdb", ExportOptions(colour=True))
    grids = parse_vdb((tmp_path / "a.vdb").read_bytes(), "")
    for name, low, high in (("density", [0, 6, 9], [0.5, 6, 9]), ("color", [-0.5, 4, 8], [1, 8, 10])):
        grid = grids[name]
        places = grid.index @ grid.matrix[:3, :3].T + grid.matrix[:3, 3]
        assert places.min(axis=0).tolist() == low and places.max(axis=0).tolist() == high


def test_crop_and_what_it_prints(
    block_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A crop at z up to 3.5 keeps 17 of the block's 33 layers, and what it removed is reported."""
    target = tmp_path / "a.vdb"
    assert cli.main([str(block_asset), str(target), "--crop", "1.25,1.75,3,9,9,1"]) == 0
    text = capsys.readouterr().out
    assert f"{17 * 25 * 17} voxels" in text and "the crop removed 48.5% of the voxels" in text
    assert "half opaque over a voxel at 11.09" in text
    assert cli.main([str(block_asset), str(target), "--crop", "9,9,9,1,1,1", "--force"]) == 1
    error = capsys.readouterr().err
    assert "some of the volume in it, got none of its 14025 vertices; they are from (0.5, 1.25, 2.5)" in error


def test_a_failed_comparison_leaves_nothing(
    block_asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    original = vdb.vdb_bytes
    monkeypatch.setattr(
        vdb, "vdb_bytes", lambda volume: original(replace(volume, density=volume.density * 2))
    )
    assert cli.main([str(block_asset), str(tmp_path / "a.vdb")]) == 1
    assert "a.vdb: density: number 0: expected" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
