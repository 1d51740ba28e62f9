"""Tests of transforms.json and COLMAP exports: the cameras see the exported world as they saw their own."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from exporters import cli, export
from exporters.formats import colmap
from exporters.formats.axes import COORDINATES, coordinates_from_world
from exporters.formats.colmap import FILES, colmap_files
from exporters.formats.points import sample_points
from exporters.formats.transforms import check_cameras, moved_cameras, transforms_bytes
from exporters.shapes.mesh import TriangleMesh
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.colmap import Lens, read_images, read_points, read_views
from player.cameras.colmap import read_cameras as read_lenses
from player.cameras.rotations import quaternion, rotation_matrix
from player.cameras.transforms import read_cameras
from player.errors import ParityError
from tests.exporters.conftest import BOX
from tests.exporters.meshes import box


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return the pixels [n, 2] of points [n, 3]: the camera's x is right, y is up, and it looks along -z."""
    local = (points - camera.c2w[:3, 3]) @ camera.c2w[:3, :3]
    x = camera.cx + camera.fx * local[:, 0] / -local[:, 2]
    y = camera.cy - camera.fy * local[:, 1] / -local[:, 2]
    return np.stack([x, y], axis=-1)


def trained(asset: Asset) -> list[Camera]:
    return read_cameras(asset.path("cameras.json"), (48, 40))


@pytest.mark.parametrize("frame", COORDINATES)
def test_cameras_see_the_moved_mesh_where_it_was(
    frame: str, opened: Asset, shells_asset: Path, tmp_path: Path
) -> None:
    path = tmp_path / "cameras.json"
    assert cli.main([str(shells_asset), str(path), "--frame", frame]) == 0
    corners = box(*BOX).vertices
    matrix = coordinates_from_world(frame, opened.world_from_model)
    moved = corners @ matrix[:3, :3].T + matrix[:3, 3]
    for before, after in zip(trained(opened), read_cameras(path), strict=True):
        assert before.name == after.name
        np.testing.assert_allclose(project(after, moved), project(before, corners), rtol=0, atol=1e-8)


def test_in_the_world_they_are_the_asset_s(opened: Asset, shells_asset: Path, tmp_path: Path) -> None:
    assert cli.main([str(shells_asset), str(tmp_path / "cameras.json")]) == 0
    for before, after in zip(trained(opened), read_cameras(tmp_path / "cameras.json"), strict=True):
        assert before.c2w.tobytes() == after.c2w.tobytes()


@pytest.mark.parametrize("first", ["./test/r_0", "./my pictures/IMG 0001.jpg"])
def test_pycolmap_reads_the_model(
    first: str,
    opened: Asset,
    shells_asset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """pycolmap, an independent program with other camera axes, projects points onto the same pixels, and
    reads names with spaces."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pycolmap

    cameras = trained(opened)
    cameras[0] = replace(cameras[0], name=first)
    monkeypatch.setattr(export, "asset_cameras", lambda asset: cameras)
    target = tmp_path / "sparse"
    arguments = [str(shells_asset), f"{target}/", "--format", "colmap", "--points", "50", "--frame", "model"]
    arguments += ["--method", "baked"]
    assert cli.main(arguments) == 0
    assert "5 cameras, 50 points" in capsys.readouterr().out
    assert sorted(path.name for path in target.iterdir()) == sorted(FILES)
    model = pycolmap.Reconstruction(str(target))
    assert model.num_images() == 5 and model.num_cameras() == 1 and model.num_points3D() == 50
    world = sample_points(box(*BOX), 50).vertices
    places = np.array([model.points3D[i].xyz for i in range(1, 51)])
    moved = np.c_[world, np.ones(50)] @ np.linalg.inv(opened.world_from_model).T
    np.testing.assert_allclose(places, moved[:, :3], rtol=0, atol=1e-6)
    by_name = {image.name: image for image in model.images.values()}
    for camera in cameras:
        image = by_name[camera.name.removeprefix("./") + ("" if camera.name.endswith(".jpg") else ".png")]
        pixels = np.array([image.project_point(place) for place in places])
        np.testing.assert_allclose(pixels, project(camera, world), rtol=0, atol=1e-4)


def test_quaternions_survive() -> None:
    random = np.random.default_rng(0)
    turns = [np.eye(3), *(np.diag(signs) for signs in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1]))]
    for _ in range(50):
        q, _ = np.linalg.qr(random.normal(size=(3, 3)))
        turns.append(q * np.sign(np.linalg.det(q)))
    for turn in turns:
        q = quaternion(turn)
        assert abs(np.linalg.norm(q) - 1) < 1e-12 and q[np.abs(q) > 1e-12][0] > 0
        np.testing.assert_allclose(rotation_matrix(q), turn, rtol=0, atol=1e-12)


def written(folder: Path, cameras: list[Camera]) -> dict[str, bytes]:
    """Write the files of the cameras and a box, and return their contents."""
    files = colmap_files(cameras, box((0, 0, 0), (1, 1, 1)))
    for file, data in files.items():
        (folder / file).write_bytes(data)
    return files


def test_lenses_are_shared(tmp_path: Path) -> None:
    camera = Camera("./pictures/a.png", np.eye(4), 4, 3, 5.0, 5.5, 2.0, 1.5)
    other = camera.resized(8, 6)
    files = written(tmp_path, [camera, other, camera])
    assert read_lenses(tmp_path / "cameras.bin") == {
        1: Lens(4, 3, 5.0, 5.5, 2.0, 1.5, {}),
        2: Lens(8, 6, 10.0, 11.0, 4.0, 3.0, {}),
    }
    assert [(image.camera_id, image.name) for image in read_images(tmp_path / "images.bin")] == [
        (number, "pictures/a.png") for number in (1, 2, 1)
    ]
    assert files == written(tmp_path, [camera, other, camera])


@pytest.mark.parametrize("name", ["a b.png", "my pictures/a.png", "9.41\u202fAM.png"])
def test_names_with_white_space_are_kept(name: str, tmp_path: Path) -> None:
    """The player's reader finds the names and cameras in the binary files; the numbers of bytes are COLMAP's:
    56 a camera, 73 and the name a picture, 51 a point."""
    camera = Camera(f"./{name}", np.eye(4), 4, 3, 5.0, 5.5, 2.0, 1.5)
    other = replace(camera.resized(8, 6), name="a.png")
    files = written(tmp_path, [camera, other, camera])
    assert tuple(files) == FILES
    assert [(image.name, image.camera_id) for image in read_images(tmp_path / "images.bin")] == [
        (name, 1), ("a.png", 2), (name, 1)
    ]  # fmt: skip
    for read, expected in zip(read_views(tmp_path), sorted([name, name, "a.png"]), strict=True):
        camera_there = other if expected == "a.png" else camera
        check_cameras([replace(camera_there, name=expected)], [read], expected, 1e-12)
    assert np.array_equal(read_points(tmp_path / "points3D.bin"), box((0, 0, 0), (1, 1, 1)).vertices)
    assert [len(data) for data in files.values()] == [
        8 + 2 * 56, 8 + 3 * 73 + 2 * len(name.encode()) + len("a.png"), 8 + 8 * 51
    ]  # fmt: skip


def test_names_without_a_suffix_are_those_of_png_files(tmp_path: Path) -> None:
    camera = Camera("./train/r_0", np.eye(4), 4, 3, 5.0, 5.5, 2.0, 1.5)
    cameras = [camera, replace(camera, name="a.JPG"), replace(camera, name="v1.2\\b")]
    written(tmp_path, cameras)
    names = [image.name for image in read_images(tmp_path / "images.bin")]
    assert names == ["train/r_0.png", "a.JPG", "v1.2/b.png"]


def test_parity() -> None:
    camera = Camera("a", np.eye(4), 4, 3, 5.0, 5.0, 2.0, 1.5)
    assert transforms_bytes([camera], np.eye(4), "t.json")
    (moved,) = moved_cameras(
        [camera], np.array([[1.0, 0, 0, 1e-3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    )
    with pytest.raises(ParityError, match=r"t\.json: a: pose: 0\.001 apart"):
        check_cameras([camera], [moved], "t.json", 1e-9)
    with pytest.raises(ParityError, match="cameras: expected 1, got 0"):
        check_cameras([camera], [], "t.json", 0.0)
    with pytest.raises(ParityError, match="expected a 4x3, got a 8x6"):
        check_cameras([camera], [camera.resized(8, 6)], "t.json", 0.0)


def test_colmap_parity(monkeypatch: pytest.MonkeyPatch) -> None:
    """A name, a quaternion, a place or a colour in the files that differs from the source is refused."""
    camera = Camera("a b", np.eye(4), 4, 3, 5.0, 5.0, 2.0, 1.5)
    corners = box((0, 0, 0), (1, 1, 1))
    write = colmap._written

    def renamed(cameras: list[Camera], cloud: TriangleMesh) -> dict[str, bytes]:
        return write([replace(camera, name="a c") for camera in cameras], cloud)

    def black(cameras: list[Camera], cloud: TriangleMesh) -> dict[str, bytes]:
        return write(cameras, replace(cloud, colours=np.zeros_like(cloud.colours)))

    def rounded(cameras: list[Camera], cloud: TriangleMesh) -> dict[str, bytes]:
        return write(cameras, replace(cloud, vertices=cloud.vertices.round(3)))

    monkeypatch.setattr(colmap, "_written", renamed)
    with pytest.raises(ParityError, match=r"images\.bin: camera: expected a b\.png 4x3, got a c 4x3"):
        colmap_files([camera], corners)
    monkeypatch.setattr(colmap, "_written", black)
    with pytest.raises(ParityError, match=r"points3D\.bin: expected 8 points as sampled, got 8 others"):
        colmap_files([camera], corners)
    monkeypatch.setattr(colmap, "_written", rounded)
    with pytest.raises(ParityError, match=r"points3D\.bin: expected 8 points as sampled, got 8 others"):
        colmap_files([camera], replace(corners, vertices=corners.vertices + 1 / 3))
    monkeypatch.undo()
    monkeypatch.setattr(colmap, "quaternion", lambda rotation: np.array([1.0, 0, 0, 0]))
    with pytest.raises(ParityError, match=r"images\.bin: a b\.png: pose: 2 apart"):
        colmap_files([camera], corners)
