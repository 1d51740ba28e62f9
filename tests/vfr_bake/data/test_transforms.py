"""Folders with a transforms.json: what is read, what is refused, and the distortion of lenses."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras
from player.errors import DataError, FormatError, MissingExtraError
from vfr_bake.data import load_scene
from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.files.opening import SUFFIXES
from vfr_bake.data.files.pictures import read_picture, undistort
from vfr_bake.data.folders import _distortion
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.store.reading import PictureReader


def picture(seed: int, width: int = 8, height: int = 6, channels: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).integers(1, 255, (height, width, channels), np.uint8)


def make_folder(folder: Path, n: int, name: str = "transforms.json", stem: str = "r_", **top: Any) -> Path:
    """Write `n` views around the demo scene as RGBA, in Blender's form unless `top` adds more keys."""
    folder.mkdir(exist_ok=True)
    frames = []
    for index, camera in enumerate(demo_cameras(8, n)):
        Image.fromarray(picture(index)).save(folder / f"{stem}{index}.png")
        frames.append({"file_path": f"./{stem}{index}", "transform_matrix": camera.c2w.tolist()})
    (folder / name).write_text(json.dumps({"camera_angle_x": 0.7, **top, "frames": frames}))
    return folder


def message(folder: Path | str, kind: type[Exception] = DataError) -> str:
    with pytest.raises(kind) as caught:
        load_scene(str(folder))
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    return text


def edit(path: Path, change: Any) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def test_blender_folder(tmp_path: Path):
    folder = make_folder(tmp_path / "toy", 5, "transforms_train.json", "train_")
    make_folder(folder, 3, "transforms_test.json", "test_")
    make_folder(folder, 1, "transforms_val.json", "val_")
    scene = load_scene(folder)
    assert scene.name == "toy" and scene.has_alpha
    assert [c.name for c in scene.test.cameras] == ["./test_0", "./test_1", "./test_2"]
    for index in range(5):
        np.testing.assert_array_equal(scene.train.images[index], picture(index))
    world = read_cameras(folder / "transforms_train.json", (8, 6))
    for camera, expected in zip(scene.train.cameras, world, strict=True):
        back = camera.transformed(scene.world_from_model)
        np.testing.assert_allclose(back.c2w, expected.c2w, atol=1e-12)
        assert (camera.fx, camera.width, camera.height) == (expected.fx, 8, 6)


def test_every_eighth_view_is_held_out(tmp_path: Path):
    scene = load_scene(make_folder(tmp_path / "a", 17))
    assert [c.name for c in scene.test.cameras] == ["./r_0", "./r_8", "./r_16"]
    assert len(scene.train.cameras) == 14 and scene.train.cameras[7].name == "./r_9"
    np.testing.assert_array_equal(scene.train.images[7], picture(9))
    np.testing.assert_array_equal(scene.test.images[1], picture(8))


def names(views: PosedImages) -> str:
    return " ".join(camera.name.removeprefix("./r_") for camera in views.cameras)


@pytest.mark.parametrize(
    ("train", "val", "test", "expected"),
    [
        ("0 1 2 3 4 5", "6 7", "8 9", ("0 1 2 3 4 5", "8 9")),
        ("0 1 2 3 4 5", "6 7", "", ("0 1 2 3 4 5", "6 7")),
        ("0 1 2", "8 9", "8 9", ("0 1 2", "8 9")),
        ("", "6 7", "8 9", ("0 1 2 3 4 5", "8 9")),
        ("", "", "8 9", ("0 1 2 3 4 5 6 7", "8 9")),
        ("0 1 2 3 8", "", "8 9", ("0 1 2 3", "8 9")),
        ("1 2 3 4 5 6 7 8 9", "", "", ("2 3 4 5 6 7 8", "1 9")),
    ],
)
def test_lists_of_nerfstudio_split_the_views(
    tmp_path: Path, train: str, val: str, test: str, expected: tuple[str, str]
):
    """Views are split by `train_filenames` and so on, whose paths may be written in another form. A test view
    is never trained on."""
    splits = {"train": train, "val": val, "test": test}
    top = {f"{split}_filenames": [f"r_{k}" for k in of.split()] for split, of in splits.items() if of}
    scene = load_scene(make_folder(tmp_path / "a", 10, **top))
    assert (names(scene.train), names(scene.test)) == expected
    np.testing.assert_array_equal(scene.test.images[0], picture(int(expected[1][0])))


def test_broken_lists_of_nerfstudio_are_named(tmp_path: Path):
    unknown = message(make_folder(tmp_path / "a", 4, test_filenames=["r_1", "r_9"]), FormatError)
    assert "transforms.json: test_filenames: expected the file_path of a frame, got r_9" in unknown
    for broken in ("r_1", [1], {"r_1": 2}):
        text = message(make_folder(tmp_path / "a", 4, val_filenames=broken), FormatError)
        assert "transforms.json: val_filenames: expected a list of file paths, got " in text
    everything = message(make_folder(tmp_path / "a", 4, test_filenames=[f"r_{k}" for k in range(4)]))
    assert "training views: expected at least 2, got 0" in everything


def test_a_frame_that_is_there_twice_is_taken_once(tmp_path: Path):
    """A repeated frame is left out, or it would be both held out and trained on."""
    folder = make_folder(tmp_path / "a", 9)

    def repeat(document: Any) -> None:
        frames = document["frames"]
        document["frames"] = [*frames, {**frames[0], "file_path": "r_0.png"}, frames[8]]

    edit(folder / "transforms.json", repeat)
    said: list[str] = []
    scene = load_scene(folder, reader=PictureReader(say=said.append))
    assert (names(scene.train), names(scene.test)) == ("1 2 3 4 5 6 7", "0 8")
    assert said[0] == "transforms.json: 2 of 11 frames repeat earlier ones, and are left out"


def test_a_picture_with_two_cameras_is_refused(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 4)
    edit(folder / "transforms.json", lambda d: d["frames"][3].update(file_path="r_1.png"))
    assert "frame 3 (r_1.png): expected one camera for each picture, got another one" in message(folder)


@pytest.mark.parametrize("change", [{"fl_x": 9.0}, {"cx": 3.5}, {"k1": 0.01}, {"w": 16, "h": 12}])
def test_a_picture_with_two_lenses_is_refused(tmp_path: Path, change: dict[str, float]):
    folder = make_folder(tmp_path / "a", 4, fl_x=8.0, cx=4.0, cy=3.0, w=8, h=6)
    edit(folder / "transforms.json", lambda d: d["frames"].append({**d["frames"][1], **change}))
    assert "frame 4 (./r_1): expected one camera for each picture, got another one" in message(folder)


def test_two_cameras_far_from_the_origin_are_told_apart(tmp_path: Path):
    """In the coordinates of a map, 45 m are a hundred thousandth of a position."""
    folder = make_folder(tmp_path / "a", 4)

    def move(document: Any) -> None:
        frames = document["frames"]
        for frame in frames:
            frame["transform_matrix"][1][3] += 4.5e6
        frames.append(json.loads(json.dumps(frames[2])))
        frames[4]["transform_matrix"][1][3] += 45

    edit(folder / "transforms.json", move)
    assert "frame 4 (./r_2): expected one camera for each picture, got another one" in message(folder)


def test_what_is_tested_with_is_not_trained_on(tmp_path: Path):
    """A picture that both files name is a test view. The files may write its path in two ways."""
    folder = make_folder(tmp_path / "a", 5, "transforms_train.json")
    make_folder(folder, 2, "transforms_test.json")
    edit(folder / "transforms_test.json", lambda d: d["frames"][1].update(file_path="../a/r_1.png"))
    said: list[str] = []
    scene = load_scene(folder, reader=PictureReader(say=said.append))
    assert (names(scene.train), names(scene.test)) == ("2 3 4", "0 ../a/r_1.png")
    assert said[0] == (
        "transforms_train.json: 2 of 5 frames are in transforms_test.json, too, and are left out"
    )


def test_a_copy_of_the_training_file_holds_nothing_out(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 9, "transforms_train.json")
    (folder / "transforms_test.json").write_bytes((folder / "transforms_train.json").read_bytes())
    said: list[str] = []
    scene = load_scene(folder, reader=PictureReader(say=said.append))
    assert (names(scene.train), names(scene.test)) == ("1 2 3 4 5 6 7", "0 8")
    assert said[0] == "transforms_test.json repeats the frames of transforms_train.json, and is not used"


def test_links_to_one_picture_are_different_pictures(tmp_path: Path):
    """A cache of downloads keeps equal pictures once, and links to them."""
    folder = make_folder(tmp_path / "a", 4)
    (folder / "r_3.png").unlink()
    (folder / "r_3.png").symlink_to(folder / "r_1.png")
    assert names(load_scene(folder).train) == "0 1 2 3"


def test_few_views_are_all_trained_on(tmp_path: Path):
    scene = load_scene(make_folder(tmp_path / "a", 7))
    assert len(scene.train.cameras) == 7 and scene.test.images == []


def test_opaque_pictures_have_no_alpha(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 3)
    for index in range(3):
        Image.fromarray(picture(index, channels=3)).save(folder / f"r_{index}.png")
    scene = load_scene(folder)
    assert not scene.has_alpha and all((image[..., 3] == 255).all() for image in scene.train.images)


def test_lego(lego_400: Path, tmp_path: Path):
    """The first views of lego are read right; the expected pixels are read by OpenCV."""
    for split, n in (("train", 6), ("test", 2)):
        (tmp_path / split).mkdir()
        for index in range(n):
            shutil.copy(lego_400 / split / f"r_{index}.png", tmp_path / split)
        document = json.loads((lego_400 / f"transforms_{split}.json").read_text())
        document["frames"] = document["frames"][:n]
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(document))
    calls: list[tuple[int, int]] = []
    scene = load_scene(tmp_path, lambda done, n: calls.append((done, n)))
    assert [image.shape for image in scene.train.images] == [(400, 400, 4)] * 6
    assert [image.shape for image in scene.test.images] == [(400, 400, 4)] * 2
    expected = cv2.imread(str(lego_400 / "train" / "r_5.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(scene.train.images[5], expected[..., [2, 1, 0, 3]])
    assert calls == [(i, 8) for i in range(1, 9)] and scene.has_alpha
    eye = scene.world_from_model @ scene.train.cameras[0].c2w[:, 3]
    np.testing.assert_allclose(np.linalg.norm(eye[:3]), 4.0311, atol=1e-3)


def test_pictures_of_another_size_than_the_file_says(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 3, w=16, h=12, fl_x=20.0, fl_y=18.0, cx=9.0, cy=5.0)
    camera = load_scene(folder).train.cameras[0]
    assert (camera.width, camera.height) == (8, 6)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10, 9, 4.5, 2.5)


@pytest.mark.parametrize("size", [(12, 16), (12, 12), (100, 50), (400, 290)])
def test_a_picture_of_another_shape_than_its_camera_is_refused(tmp_path: Path, size: tuple[int, int]):
    """Pictures that were turned or cropped do not fit their cameras: rays would be wrong without a word."""
    width, height = (100 * side for side in size)
    folder = make_folder(tmp_path / "a", 3, w=width, h=height, fl_x=20.0)
    for index in range(3):
        Image.fromarray(picture(index, 160, 120)).save(folder / f"r_{index}.png")
    text = message(folder)
    assert f"frame 0 (./r_0): size: expected a picture of the shape of its camera, {width}x{height}" in text
    assert "got 160x120 in r_0.png" in text


@pytest.mark.parametrize("size", [(1297, 840), (840, 1297), (30, 17)])
@pytest.mark.parametrize("factor", [2, 3, 4, 8])
def test_a_picture_that_was_made_smaller_may_be_rounded(
    tmp_path: Path, size: tuple[int, int], factor: int
) -> None:
    folder = make_folder(tmp_path / "a", 2, w=size[0], h=size[1], fl_x=20.0)
    rounded = (size[0] // factor, -(-size[1] // factor))
    for index in range(2):
        Image.fromarray(picture(index, *rounded)).save(folder / f"r_{index}.png")
    assert load_scene(folder).train.cameras[0].width == rounded[0]


def test_suffixes_and_separators(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 3)
    (folder / "sub").mkdir()
    Image.fromarray(picture(1, channels=3)).save(folder / "sub" / "x.jpeg")
    Image.fromarray(picture(2, channels=3)).save(folder / "y.jpg")
    (folder / "r_2").mkdir()  # a folder of that name is not the picture

    def change(document: Any) -> None:
        document["frames"][0]["file_path"] = "sub\\x"
        document["frames"][1]["file_path"] = "y.jpg"

    edit(folder / "transforms.json", change)
    scene = load_scene(folder)
    assert [c.name for c in scene.train.cameras] == ["sub\\x", "y.jpg", "./r_2"]
    np.testing.assert_array_equal(scene.train.images[2], picture(2))


# --- pictures ---


def test_kinds_of_pictures(tmp_path: Path):
    path = tmp_path / "p.png"
    grey = picture(0, channels=1)[..., 0]
    opaque = np.full_like(grey, 255)
    expected = np.stack([grey, grey, grey, opaque], axis=-1)
    Image.fromarray(grey).save(path)
    np.testing.assert_array_equal(read_picture(path), expected)
    Image.fromarray(np.stack([grey, opaque // 3], axis=-1)).save(path)
    np.testing.assert_array_equal(read_picture(path), np.dstack([grey, grey, grey, opaque // 3]))
    palette = Image.fromarray(grey // 64).convert("P")
    palette.putpalette([10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 110, 120])
    palette.save(path, transparency=0)
    colours = np.array([[10, 20, 30, 0], [40, 50, 60, 255], [70, 80, 90, 255], [100, 110, 120, 255]])
    np.testing.assert_array_equal(read_picture(path), colours[np.asarray(palette)])
    Image.fromarray(grey > 128).save(path)
    np.testing.assert_array_equal(read_picture(path)[..., 0], np.where(grey > 128, 255, 0))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bits(tmp_path: Path, channels: int):
    path = tmp_path / "p.png"
    values = np.random.default_rng(channels).integers(0, 65536, (6, 8, channels), np.uint16)
    values[0, 0], values[0, 1] = 0, 65535
    assert cv2.imwrite(str(path), values)  # BGR
    read = read_picture(path)
    expected = values / 257.0
    order = {1: [0, 0, 0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[channels]
    np.testing.assert_allclose(read[..., : len(order)], expected[..., order], atol=0.5001)
    assert read[0, 1, 0] == 255 and read[0, 0, 0] == 0


def test_floating_point_is_refused(tmp_path: Path):
    Image.fromarray(np.ones((2, 2), np.float32)).save(tmp_path / "p.tif")
    with pytest.raises(DataError, match=r"p\.tif: picture: expected 8 or 16 bits a channel"):
        read_picture(tmp_path / "p.tif")


# --- errors ---


def test_missing_folder(tmp_path: Path):
    text = message(tmp_path / "nowhere")
    assert text.startswith(f"{tmp_path / 'nowhere'}: no such folder: expected one with pictures and cameras")


def test_a_file_in_the_folders_place(tmp_path: Path):
    (tmp_path / "f").write_text("x")
    assert "expected a folder with a transforms.json or a COLMAP model, got a file" in message(tmp_path / "f")


def test_empty_folder_and_folder_without_transforms(tmp_path: Path):
    expected = (
        f"{tmp_path}: expected transforms_train.json, transforms.json or sparse/0/images.bin in it, got "
    )
    assert message(tmp_path) == expected + "an empty folder"
    (tmp_path / "IMG_1.DNG").write_bytes(b"")
    assert message(tmp_path) == expected + "none of them; there are .dng files: save them as JPEG"
    (tmp_path / "picture.png").write_bytes(b"")
    assert (expected + "pictures alone: vfr-train estimates their cameras") in message(tmp_path)


def test_no_frames(tmp_path: Path):
    (tmp_path / "transforms_train.json").write_text('{"camera_angle_x": 0.7, "frames": []}')
    text = message(tmp_path, FormatError)
    assert "transforms_train.json: frames: expected a list of at least one frame, got []" in text


def test_a_missing_picture(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 3)
    (folder / "r_1.png").unlink()
    text = message(folder)
    assert "transforms.json: frame 1 (./r_1): picture is missing: expected " in text
    assert str(folder / "r_1") in text and text.endswith(f"with one of {', '.join(SUFFIXES)}")


def test_a_name_too_long_is_a_missing_picture(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 3)
    edit(folder / "transforms.json", lambda d: d["frames"][1].update(file_path="x" * 4000))
    assert "frame 1 (xxx" in message(folder)


@pytest.mark.parametrize(("suffix", "n_bytes"), [("png", 40), ("jpg", 20)])
def test_a_truncated_picture(tmp_path: Path, suffix: str, n_bytes: int):
    folder = make_folder(tmp_path / "a", 3)
    path = folder / f"r_1.{suffix}"
    (folder / "r_1.png").unlink()
    Image.fromarray(picture(1, 8, 6, 3)).save(path)
    data = path.read_bytes()
    path.write_bytes(data[:-n_bytes])
    assert message(folder).startswith(f"{path}: picture: cannot be read to its end: ")


def test_a_picture_that_is_not_one(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 3)
    (folder / "r_2.png").write_text("hello")
    assert message(folder).startswith(f"{folder / 'r_2.png'}: picture: expected JPEG, PNG, ")


def test_pictures_of_different_sizes(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 3)
    Image.fromarray(picture(1, 16, 5)).save(folder / "r_2.png")
    scene = load_scene(folder)
    assert [image.shape[:2] for image in scene.train.images] == [(6, 8), (6, 8), (5, 16)]
    first, last = scene.train.cameras[0], scene.train.cameras[2]
    assert (last.width, last.height) == (16, 5)
    # The file gives an angle of view and no size: it is the angle of each picture's own width.
    assert last.fx == pytest.approx(2 * first.fx) and last.fy == pytest.approx(last.fx)


def test_a_bad_matrix(tmp_path: Path):
    folder = make_folder(tmp_path / "a", 3)
    edit(folder / "transforms.json", lambda d: d["frames"][2].update(transform_matrix=[[1, 2], [3, 4]]))
    text = message(folder, FormatError)
    assert "frame 2 (./r_2): camera matrix: expected 4 rows of 4 numbers, got 2 rows" in text


def test_one_view_is_not_enough(tmp_path: Path):
    assert "training views: expected at least 2, got 1" in message(make_folder(tmp_path / "a", 1))


# --- lenses ---

LENS = {"k1": -0.12, "k2": 0.05, "k3": -0.01, "k4": 0.004, "p1": 0.004, "p2": -0.003}


def distorted_view(camera: Camera, lens: dict[str, float], shade: Any) -> np.ndarray:
    """Return `shade(x, y)`, the plane at depth 1, as seen by a lens, whose model is inverted by iteration."""
    u = (np.arange(camera.width) + 0.5 - camera.cx)[None, :] / camera.fx + np.zeros((camera.height, 1))
    v = (np.arange(camera.height) + 0.5 - camera.cy)[:, None] / camera.fy + np.zeros((1, camera.width))
    x, y = u.copy(), v.copy()
    for _ in range(60):
        r2 = x * x + y * y
        radial = 1 + lens["k1"] * r2 + lens["k2"] * r2**2 + lens["k3"] * r2**3 + lens["k4"] * r2**4
        x = (u - 2 * lens["p1"] * x * y - lens["p2"] * (r2 + 2 * x * x)) / radial
        y = (v - lens["p1"] * (r2 + 2 * y * y) - 2 * lens["p2"] * x * y) / radial
    return shade(x, y)


def smooth(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a plane of smooth colours as a picture."""
    channels = [np.sin(9 * x + 1), np.sin(7 * y), np.sin(6 * x - 8 * y), np.ones_like(x)]
    return (np.stack(channels, axis=-1) * 120 + 128).round().astype(np.uint8)


def test_a_lens_is_made_straight():
    camera = Camera("a", np.eye(4), 96, 80, 70.0, 75.0, 46.0, 41.5)
    no_lens = dict.fromkeys(LENS, 0.0)
    bent, straight = (distorted_view(camera, lens, smooth).astype(int) for lens in (LENS, no_lens))
    assert np.abs(bent - straight)[8:-8, 8:-8].max() > 20
    result = undistort(bent.astype(np.uint8), camera, **LENS)
    # Linear interpolation of a sine, at most 0.14 radians a pixel: 120 * 0.14² / 8, and two roundings.
    assert np.abs(result.astype(int) - straight)[8:-8, 8:-8].max() <= 2


def test_undistort_agrees_with_opencv_where_it_can():
    camera = Camera("a", np.eye(4), 64, 48, 50.0, 52.0, 31.0, 25.0)
    image = cv2.GaussianBlur(picture(3, 64, 48), (7, 7), 2)
    image[..., 3] = 255
    lens = {**LENS, "k4": 0.0}
    matrix = np.array([[50.0, 0, 30.5], [0, 52, 24.5], [0, 0, 1]])
    expected = cv2.undistort(image, matrix, np.array([lens[k] for k in ("k1", "k2", "p1", "p2", "k3")]))
    result = undistort(image, camera, **lens)
    difference = np.abs(result.astype(int) - expected)[8:-8, 8:-8]
    assert difference.max() <= 2  # OpenCV rounds positions to 1/32 pixel and colours as integers
    assert np.abs(result.astype(int) - image)[8:-8, 8:-8].max() > 8


def test_hidden_colours_do_not_bleed():
    image = np.zeros((20, 20, 4), np.uint8)
    image[:, :10] = [200, 100, 50, 255]
    image[:, 10:] = [0, 255, 0, 0]  # green, but transparent
    result = undistort(image, Camera("a", np.eye(4), 20, 20, 20.0, 20.0, 7.0, 10.0), k1=0.4)
    partly = result[result[..., 3] > 8]
    assert len(np.unique(partly[:, 3])) > 2
    assert np.abs(partly[:, :3].astype(int) - [200, 100, 50]).max() <= 2


def test_lenses_of_a_folder_are_undone(tmp_path: Path):
    cameras = [Camera("a", c.c2w, 96, 80, 70.0, 75.0, 46.0, 41.5) for c in demo_cameras(8, 3)]
    folder = make_folder(tmp_path / "a", 3, w=96, h=80, fl_x=70.0, fl_y=75.0, cx=46.0, cy=41.5, **LENS)
    edit(folder / "transforms.json", lambda d: d["frames"][2].update(dict.fromkeys(LENS, 0.0)))
    bent = distorted_view(cameras[0], LENS, smooth)
    bent[..., 3] = 255
    for index in range(3):
        Image.fromarray(bent).save(folder / f"r_{index}.png")
    scene = load_scene(folder)
    straight = distorted_view(cameras[0], dict.fromkeys(LENS, 0.0), smooth).astype(int)
    assert np.abs(scene.train.images[1].astype(int) - straight)[8:-8, 8:-8, :3].max() <= 2
    np.testing.assert_array_equal(scene.train.images[2], bent)  # this frame has a lens without distortion
    assert not scene.has_alpha


def test_a_lens_that_is_not_a_number(tmp_path: Path):
    assert "frame 0 (./r_0): k1: expected a finite number, got '1'" in message(
        make_folder(tmp_path / "a", 3, k1="1"), FormatError
    )


def test_distortion_in_the_list_of_nerfstudio(tmp_path: Path):
    """A frame's numbers take precedence over those at the top, and named ones over a list."""
    folder = make_folder(tmp_path / "a", 4, distortion_params=[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], k2=0.7)
    path = folder / "transforms.json"
    edit(path, lambda d: d["frames"][1].update(distortion_params=[1, 2, 3, 4, 5, 6]))
    edit(path, lambda d: d["frames"][2].update(k1=0, distortion_params=[1, 2, 3, 4, 5, 6]))
    found = [list(_distortion(json.loads(path.read_text()), path, index).values()) for index in range(3)]
    assert found == [[0.1, 0.7, 0.3, 0.4, 0.5, 0.6], [1, 2, 3, 4, 5, 6], [0, 2, 3, 4, 5, 6]]
    for broken in ([0.1, 0.2], [0.1] * 5 + ["x"], "k1", {"k1": 0.1}):
        edit(path, lambda d, broken=broken: d["frames"][3].update(distortion_params=broken))
        assert "frame 3 (./r_3): distortion_params: expected 6 finite numbers, k1" in message(
            folder, FormatError
        )


def test_without_opencv_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'vfr-bake\[train\]'"):
        undistort(picture(0), Camera("a", np.eye(4), 8, 6, 5.0, 5.0, 4.0, 3.0), k1=0.1)
