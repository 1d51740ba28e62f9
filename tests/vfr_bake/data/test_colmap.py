"""COLMAP models: one that is written here by hand, a real one, and files that are cut short."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from player.cameras.camera import Camera
from player.cameras.colmap import read_cameras, read_images, read_points
from player.cameras.rotations import OPENGL_FROM_OPENCV
from player.cameras.views import read_views
from player.errors import DataError, FormatError
from vfr_bake.data import load_scene
from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.files.estimate_record import EstimateRecord, read_record, write_record
from vfr_bake.data.folders import load_folder
from vfr_bake.data.store.reading import PictureReader

SIZE = 24
LENSES = {
    1: (0, [30.0, 12.0, 12.0]),
    2: (1, [30.0, 31.0, 12.0, 11.0]),
    3: (2, [30.0, 12.0, 12.0, 0.01]),
    4: (3, [30.0, 12.0, 12.0, 0.01, -0.02]),
    5: (4, [30.0, 31.0, 12.0, 11.0, 0.01, -0.02, 0.001, 0.002]),
}


def write_model(folder: Path, cameras: list[Camera], lenses: dict = LENSES, size: int = SIZE) -> Path:
    """Write a COLMAP model of `cameras`, which take the lenses in turn, and their pictures."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (folder / "images").mkdir()
    data = struct.pack("<Q", len(lenses))
    for number, (kind, parameters) in lenses.items():
        data += struct.pack(f"<iiQQ{len(parameters)}d", number, kind, size, size, *parameters)
    (model / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(cameras))
    for index, camera in enumerate(cameras):
        world_to_camera = np.linalg.inv(camera.c2w @ OPENGL_FROM_OPENCV)
        x, y, z, w = Rotation.from_matrix(world_to_camera[:3, :3]).as_quat()
        pose = [w, x, y, z, *world_to_camera[:3, 3]]
        name = f"{index:03d}.png"
        data += struct.pack("<i7di", index + 1, *pose, list(lenses)[index % len(lenses)])
        data += name.encode() + b"\0" + struct.pack("<Q", 2) + struct.pack("<ddq", 1.0, 2.0, -1) * 2
        pixels = np.random.default_rng(index).integers(0, 255, (SIZE, SIZE, 3), np.uint8)
        Image.fromarray(pixels).save(folder / "images" / name)
    (model / "images.bin").write_bytes(data)
    data = struct.pack("<Q", 2)
    for number in range(2):
        data += struct.pack("<Q3d3BdQ2i", number, 0.1, 0.2, 0.3 + number, 9, 9, 9, 0.5, 1, 1, 0)
    (model / "points3D.bin").write_bytes(data)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_model(tmp_path / "toy", demo_cameras(SIZE, 10))


def test_poses_and_lenses_come_back(folder: Path) -> None:
    capture = load_folder(folder)
    assert capture.name == "toy" and len(capture.train.cameras) == 8 and len(capture.test.cameras) == 2
    wanted = demo_cameras(SIZE, 10)
    for camera in (*capture.train.cameras, *capture.test.cameras):
        np.testing.assert_allclose(camera.c2w, wanted[int(camera.name[:3])].c2w, atol=1e-9)
    assert capture.train.cameras[0].name == "001.png" and capture.test.cameras[1].name == "008.png"
    assert (capture.train.cameras[0].fx, capture.train.cameras[0].fy) == (30.0, 31.0)
    assert capture.points is not None and capture.points.tolist() == [[0.1, 0.2, 0.3], [0.1, 0.2, 1.3]]
    lens = read_cameras(folder / "sparse/0/cameras.bin")[5]
    assert lens.distortion == {"k1": 0.01, "k2": -0.02, "p1": 0.001, "p2": 0.002}


def test_pictures_that_were_made_smaller_keep_their_view(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "toy", demo_cameras(SIZE, 10), {1: (0, [60.0, 24.0, 24.0])}, 2 * SIZE)
    camera = load_folder(folder).train.cameras[0]
    assert (camera.width, camera.fx, camera.cx) == (SIZE, 30.0, 12.0)


def test_pictures_of_another_shape_are_refused(folder: Path) -> None:
    Image.new("RGB", (2 * SIZE, SIZE)).save(folder / "images/003.png")
    with pytest.raises(DataError, match=r"003\.png: size: expected a picture of the shape of its"):
        load_folder(folder)


def test_the_real_capture(can: Path) -> None:
    scene = load_scene(can, downscale=4)
    assert (len(scene.train.cameras), len(scene.test.cameras)) == (62, 9)
    assert scene.unbounded and 0 < scene.near < 0.5
    assert scene.train.images[0].shape == (320, 180, 4)


def test_points_fall_on_what_was_seen_of_them(can: Path) -> None:
    """The real model's points, projected by the cameras that are read, fall where COLMAP saw them."""
    reconstruction = pycolmap.Reconstruction(str(can / "sparse/0"))
    lenses = read_cameras(can / "sparse/0/cameras.bin")
    ours = {image.name: image for image in read_images(can / "sparse/0/images.bin")}
    assert len(read_points(can / "sparse/0/points3D.bin")) == len(reconstruction.points3D)
    errors = []
    for image in list(reconstruction.images.values())[::10]:
        pose, lens = ours[image.name], lenses[image.camera_id]
        for seen in image.get_observation_points2D():
            point = reconstruction.points3D[seen.point3D_id].xyz
            local = pose.c2w[:3, :3].T @ (point - pose.c2w[:3, 3])
            x, y = local[0] / -local[2], -local[1] / -local[2]
            radial = 1 + lens.distortion["k1"] * (x * x + y * y)
            pixel = np.array([lens.fx * x * radial + lens.cx, lens.fy * y * radial + lens.cy])
            errors.append(np.linalg.norm(pixel - seen.xy))
    assert len(errors) > 1000 and float(np.median(errors)) < 1.5


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("kept", [0, 7, 8, 60, -1])
def test_a_model_cut_short_is_named(folder: Path, name: str, kept: int) -> None:
    path = folder / "sparse/0" / name
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(FormatError, match=rf"{name}: cut short") as caught:
        load_folder(folder)
    assert "\n" not in str(caught.value)


def test_a_count_that_the_file_cannot_hold_costs_no_memory(folder: Path) -> None:
    path = folder / "sparse/0/images.bin"
    path.write_bytes(struct.pack("<Q", 2**60) + path.read_bytes()[8:])
    with pytest.raises(FormatError, match="entries do not fit"):
        load_folder(folder)


def test_what_cannot_be_served_is_said(folder: Path, tmp_path: Path) -> None:
    (folder / "images/004.png").unlink()
    with pytest.raises(DataError, match=r"004\.png: picture is missing"):
        load_folder(folder)
    path = folder / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes().replace(b"004.png", b"4" * 300 + b".png"))
    with pytest.raises(DataError, match=r"444\.png: picture is missing"):
        load_folder(folder)
    fisheye = write_model(tmp_path / "fish", demo_cameras(SIZE, 4), {1: (5, [9.0] * 8)})
    with pytest.raises(DataError, match=r"model: expected SIMPLE_PINHOLE, .* got number 5"):
        load_folder(fisheye)
    flat = write_model(tmp_path / "flat", demo_cameras(SIZE, 4), {1: (0, [0.0, 12.0, 12.0])})
    with pytest.raises(FormatError, match="positive focal length"):
        load_folder(flat)
    alone = write_model(tmp_path / "alone", demo_cameras(SIZE, 1))
    with pytest.raises(DataError, match="registered pictures: expected at least 2, got 1"):
        load_folder(alone)


def test_the_largest_of_several_models_is_taken(folder: Path, tmp_path: Path) -> None:
    """COLMAP numbers the models of groups that do not fit together in the order in which it began them."""
    (folder / "sparse" / "0").rename(folder / "sparse" / "10")
    small = write_model(tmp_path / "small", demo_cameras(SIZE, 3))
    (small / "sparse" / "0").rename(folder / "sparse" / "0")
    for name in ("010.png", "011.png"):
        Image.new("RGB", (SIZE, SIZE)).save(folder / "images" / name)
    said: list[str] = []
    capture = load_folder(folder, None, PictureReader(say=said.append))
    assert len(capture.train.cameras) + len(capture.test.cameras) == len(read_views(folder)) == 10
    assert said[:2] == [
        f"of 2 COLMAP models {folder / 'sparse' / '10'} is used, which has the most pictures",
        "10 of 12 pictures have cameras; the others are not used",
    ]


def test_other_pictures_under_the_old_names_are_told_of(folder: Path) -> None:
    """Pictures of another size than those that were estimated are named; a record without sizes says
    nothing."""
    model, said = folder / "sparse" / "0", []
    n_bytes = {path.name: path.stat().st_size for path in (folder / "images").iterdir()}
    write_record(model, EstimateRecord(True, n_bytes=n_bytes))
    assert read_record(model).n_bytes == n_bytes
    load_folder(folder, None, PictureReader(say=said.append))
    assert not [text for text in said if "estimated" in text]
    for name in ("003.png", "005.png"):
        Image.new("RGB", (SIZE, SIZE)).save(folder / "images" / name)
    load_folder(folder, None, PictureReader(say=said.append))
    (text,) = (text for text in said if "estimated" in text)
    assert text == (
        "2 of 10 pictures are not those whose cameras were estimated (003.png): remove "
        f"{folder / 'sparse'} to have the cameras estimated anew"
    )
    (model / "pictures.json").write_text('{"upright": true}')
    said.clear()
    load_folder(folder, None, PictureReader(say=said.append))
    assert not [text for text in said if "estimated" in text]
    (model / "pictures.json").write_text('{"upright": true, "n_bytes": {"003.png": "9"}}')
    with pytest.raises(FormatError, match="n_bytes: expected sizes of files: remove"):
        load_folder(folder)


def test_pictures_that_were_removed_after_the_estimate_are_left_out(folder: Path) -> None:
    """The others are used as long as two are left. Cameras of another program need all their pictures."""
    said: list[str] = []
    write_record(folder / "sparse" / "0", EstimateRecord(True))
    for index in (4, 7):
        (folder / "images" / f"{index:03d}.png").unlink()
    capture = load_folder(folder, None, PictureReader(say=said.append))
    assert len(capture.train.cameras) + len(capture.test.cameras) == 8
    assert any(
        text.startswith("2 of 10 pictures whose cameras were estimated are missing (004.png), and the others")
        for text in said
    )
    for index in (0, 1, 2, 3, 5, 6, 8):
        (folder / "images" / f"{index:03d}.png").unlink()
    with pytest.raises(
        DataError, match=r"expected at least 2, got 1 \(000\.png is missing\): remove .*sparse"
    ):
        load_folder(folder)


def test_a_scale_by_a_picture_that_was_left_out(folder: Path) -> None:
    write_record(folder / "sparse" / "0", EstimateRecord(True, {"IMG_9.png": "003.png"}))
    with pytest.raises(
        DataError, match=r"scale: IMG_9: expected .* got one without: shows what 003\.png does"
    ):
        load_scene(folder, scale=("000", "IMG_9", 2.0))


def test_a_name_that_leaves_the_folder_is_refused(folder: Path) -> None:
    path = folder / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes().replace(b"003.png", b"../3png"))
    with pytest.raises(FormatError, match="expected a picture inside the folder"):
        load_folder(folder)
