"""Pictures of every format with every orientation: read upright if cameras are estimated, and as stored if
the data have cameras that fit the stored pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageOps, PngImagePlugin

from player.cameras.transforms import write_cameras
from player.errors import DataError
from vfr_bake.data import load_scene
from vfr_bake.data.demo import demo_views
from vfr_bake.data.files.orientation import TAG, as_stored, read_layout, turned_upright
from vfr_bake.data.files.pictures import decoding_bytes, read_picture
from vfr_bake.data.looks import sensor_of

pillow_heif.register_heif_opener()

LOSSLESS = {"png": {}, "webp": {"lossless": True}, "tiff": {}}
LOSSY = {"jpg": {"quality": 95}, "avif": {"quality": 95}, "heic": {"quality": 95}}
TURN = Image.Transpose
TO_STORED = {
    1: None, 2: TURN.FLIP_LEFT_RIGHT, 3: TURN.ROTATE_180, 4: TURN.FLIP_TOP_BOTTOM, 5: TURN.TRANSPOSE,
    6: TURN.ROTATE_90, 7: TURN.TRANSVERSE, 8: TURN.ROTATE_270,
}  # fmt: skip


def corners() -> np.ndarray:
    """Return a picture [48, 32, 3] with a colour in each quarter, so that all its turns differ."""
    pixels = np.zeros((48, 32, 3), np.uint8)
    pixels[:24, :16], pixels[:24, 16:], pixels[24:, :16] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    return pixels


def save_turned(upright: np.ndarray, path: Path, number: int, **options: object) -> np.ndarray:
    """Save a picture as a camera in this orientation does, and return the pixels as stored."""
    image, turn = Image.fromarray(upright), TO_STORED[number]
    stored = image if turn is None else image.transpose(turn)
    exif = Image.Exif()
    exif[TAG] = number
    stored.save(path, exif=exif.tobytes(), **options)
    return np.asarray(stored)


@pytest.mark.parametrize("number", range(1, 9))
def test_turns_are_pillows(number: int) -> None:
    stored = np.random.default_rng(number).integers(0, 256, (3, 5, 4), np.uint8)
    image = Image.fromarray(stored)
    image.getexif()[TAG] = number
    np.testing.assert_array_equal(turned_upright(stored, number), np.asarray(ImageOps.exif_transpose(image)))
    np.testing.assert_array_equal(as_stored(turned_upright(stored, number), number), stored)


@pytest.mark.parametrize("number", range(1, 9))
@pytest.mark.parametrize("kind", [*LOSSLESS, *LOSSY])
def test_every_format_is_turned_once(kind: str, number: int, tmp_path: Path) -> None:
    path, upright = tmp_path / f"ein Bild \u56fe\u7247.{kind}", corners()
    stored = save_turned(upright, path, number, **(LOSSLESS | LOSSY)[kind])
    for read, expected in ((read_picture(path, upright=True), upright), (read_picture(path), stored)):
        assert read.shape == (*expected.shape[:2], 4) and (read[..., 3] == 255).all()
        off = np.abs(read[..., :3].astype(int) - expected)
        assert off.max() == 0 if kind in LOSSLESS else off.mean() < 6


@pytest.mark.parametrize("where", ["none", "before", "behind"])
def test_no_pixel_of_a_png_is_decoded_for_its_exif(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """EXIF before or behind the pixels of a PNG is read without decoding a pixel."""

    def never(*_: object) -> None:
        raise AssertionError("decoded")

    path = tmp_path / "a.png"
    stored = save_turned(corners(), path, 6)
    data = path.read_bytes()
    begin = data.index(b"eXIf") - 4
    end = begin + 12 + int.from_bytes(data[begin : begin + 4], "big")
    if where != "before":
        data, exif = data[:begin] + data[end:], data[begin:end]
        path.write_bytes(data[:-12] + (exif if where == "behind" else b"") + data[-12:])
    with monkeypatch.context() as without:
        without.setattr(PngImagePlugin.PngImageFile, "load", never)
        layout = read_layout(path)
        sensor_of(path, *layout.upright_size)
    assert layout.size == (48, 32) and layout.number == (1 if where == "none" else 6)
    expected = stored if where == "none" else corners()
    np.testing.assert_array_equal(read_picture(path, upright=True)[..., :3], expected)


@pytest.mark.parametrize("n_bytes", [1, 200, 3000])
def test_a_heic_that_is_cut_short(n_bytes: int, tmp_path: Path) -> None:
    path = tmp_path / "IMG_1.HEIC"
    noise = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    Image.fromarray(noise).save(path, quality=90)
    path.write_bytes(path.read_bytes()[:-n_bytes])
    with pytest.raises(DataError, match="HEIC picture: cannot be read to its end: it is cut short") as raised:
        read_picture(path, upright=True)
    assert str(raised.value).startswith(f"{path}: ") and "\n" not in str(raised.value)


@pytest.mark.parametrize("where", ["header", "pixels"])
def test_a_damaged_avif(where: str, tmp_path: Path) -> None:
    """Pillow raises RuntimeError, when it opens the file or when it decodes the pixels."""
    path = tmp_path / "a.avif"
    Image.fromarray(corners()).save(path)
    data = path.read_bytes()
    pixels = data.index(b"mdat") + 4
    broken = data.replace(b"iloc", b"free") if where == "header" else data[:pixels].ljust(len(data), b"\xff")
    path.write_bytes(broken)
    with pytest.raises(DataError, match="picture: cannot be read to its end: Failed to decode ") as raised:
        read_picture(path)
    assert str(raised.value).startswith(f"{path}: ") and "\n" not in str(raised.value)
    assert (decoding_bytes(path) == 1) == (where == "header")
    assert sensor_of(path, 32, 48).focal is None


def test_the_content_and_not_the_name_says_what_a_picture_is(tmp_path: Path) -> None:
    Image.fromarray(corners()).save(tmp_path / "a.heic", format="PNG")
    np.testing.assert_array_equal(read_picture(tmp_path / "a.heic")[..., :3], corners())


def test_a_heic_of_too_many_pixels_is_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.heic"
    Image.fromarray(corners()).save(path)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 500)
    with pytest.raises(DataError, match="Image size"):
        read_picture(path)


@pytest.mark.parametrize("suffix", [".heic", ".jpg", ".png"])
def test_a_picture_of_fewer_pixels_than_are_refused_is_read_without_a_warning(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow warns of pictures of half as many pixels as it refuses; in the tests a warning is an error."""
    path = tmp_path / f"a{suffix}"
    Image.fromarray(corners()).save(path)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", corners()[..., 0].size - 1)
    assert read_picture(path).shape[:2] == corners().shape[:2]


# --- cameras that come with a data set ---


def data_set(folder: Path, kind: str, with_size: str) -> tuple[Path, list[np.ndarray]]:
    """Write four views of the demo scene, 48 pixels high and 32 wide as stored, which EXIF turns by a
    quarter.

    `with_size`: the cameras name the size of the pixels as stored, the size of the upright picture, or none.
    """
    train, _ = demo_views(48, 4, 1)
    cameras, stored = [], []
    for index, (camera, image) in enumerate(zip(train.cameras, train.images, strict=True)):
        pixels = np.ascontiguousarray(image[:, 8:40, :3])
        camera = replace(camera, width=32, cx=camera.cx - 8, name=f"{index}.{kind}")
        if with_size == "upright":
            upright = turned_upright(pixels, 6)
            camera = replace(camera, width=48, height=32, cx=camera.cy, cy=camera.cx)
            save_turned(upright, folder / camera.name, 6, **(LOSSLESS | LOSSY)[kind])
            stored.append(upright)
        else:
            stored.append(
                save_turned(turned_upright(pixels, 6), folder / camera.name, 6, **(LOSSLESS | LOSSY)[kind])
            )
        cameras.append(camera)
    text = write_cameras(cameras).decode()
    if with_size == "none":
        text = text.replace('"w": 32,', "").replace('"h": 48,', "")
    (folder / "transforms.json").write_text(text)
    return folder, stored


@pytest.mark.parametrize("with_size", ["stored", "upright", "none"])
@pytest.mark.parametrize("kind", ["png", "jpg", "tiff", "heic"])
def test_given_cameras_belong_to_the_pixels_that_they_fit(kind: str, with_size: str, tmp_path: Path) -> None:
    if (kind, with_size) == ("heic", "none"):
        with_size = "upright"  # every reader reads a HEIC upright
    folder, expected = data_set(tmp_path, kind, with_size)
    scene = load_scene(folder)
    for camera, image, pixels in zip(scene.train.cameras, scene.train.images, expected, strict=True):
        assert (camera.height, camera.width) == image.shape[:2] == pixels.shape[:2]
        assert np.abs(image[..., :3].astype(int) - pixels).mean() < (0.5 if kind in LOSSLESS else 12)
