"""Features, size and sharpness of a photograph whose camera is still unknown: they are the same if EXIF turns
the picture, and if a part of its pixels is decoded only."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from player.progress import Progress
from tests.vfr_bake.data.files.test_orientation import save_turned
from vfr_bake.data import threads
from vfr_bake.data.features import find_features, match
from vfr_bake.data.files.pictures import decoding_bytes, read_picture
from vfr_bake.data.kept_matches import KeptMatches
from vfr_bake.data.looks import look_at
from vfr_bake.data.quality.repeats import repeats


def blots(width: int, height: int, size: int = 8) -> np.ndarray:
    """Return a picture [height, width, 3] uint8 that is full of features."""
    random = np.random.default_rng(0)
    coarse = random.integers(0, 256, (height // size + 1, width // size + 1, 3), np.uint8)
    return np.asarray(Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC))


@pytest.mark.parametrize("number", [3, 6, 8])
def test_a_picture_that_exif_turns_is_its_upright_twin(number: int, tmp_path: Path) -> None:
    """A picture turned by EXIF gives the same features, to the bit, as one that is stored upright."""
    upright = blots(160, 120)
    save_turned(upright, tmp_path / "turned.png", number)
    Image.fromarray(upright).save(tmp_path / "upright.png")
    paths = [(tmp_path / "turned.png", None), (tmp_path / "upright.png", None)]
    a, b = look_at(paths, KeptMatches(tmp_path / "kept"), None)
    assert a.sensor == b.sensor and (a.sensor.width, a.sensor.height) == (160, 120)
    assert len(a.features.points) > 50 and a.sharpness == b.sharpness
    assert np.array_equal(a.features.points, b.features.points)
    assert np.array_equal(a.features.sift, b.features.sift)


@pytest.mark.parametrize("size", [(3601, 1203), (1501, 3302)])
def test_features_of_a_large_photograph_are_where_all_its_pixels_have_them(
    size: tuple[int, int], tmp_path: Path
) -> None:
    """Features of a JPEG decoded at half its size, rounded up, lie where those of the whole picture do."""
    path = tmp_path / "large.jpg"
    Image.fromarray(blots(*size, size=40)).save(path, quality=95)
    (seen,) = look_at([(path, None)], KeptMatches(tmp_path / "kept"), None)
    assert (seen.sensor.width, seen.sensor.height) == size
    with Image.open(path) as file:
        whole = find_features(np.asarray(file.convert("RGBA")))
    pairs = match(seen.features.descriptors, whole.descriptors)
    assert len(pairs) > 0.5 * len(whole.points) > 100
    off = seen.features.points[pairs[:, 0]] - whole.points[pairs[:, 1]]
    assert np.abs(np.median(off, axis=0)).max() < 0.1 and np.median(np.abs(off)) < 0.5


def test_what_is_kept_is_not_looked_at_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.fromarray(blots(160, 120)).save(tmp_path / "a.png")
    progress: Progress = lambda done, of: None  # noqa: E731
    (first,) = look_at([(tmp_path / "a.png", None)], KeptMatches(tmp_path / "kept"), progress)
    monkeypatch.setattr("vfr_bake.data.looks.find_features", None)
    (again,) = look_at([(tmp_path / "a.png", None)], KeptMatches(tmp_path / "kept"), progress)
    assert again.sharpness == first.sharpness and np.array_equal(again.features.sift, first.features.sift)


def test_large_pictures_are_decoded_by_fewer_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A JPEG is decoded at a part of its size, a PNG and a picture with a mask as a whole."""
    monkeypatch.setattr(threads, "default_threads", lambda: 8)
    monkeypatch.setattr(threads, "MOST_BYTES", 4 * 3840 * 2560 * 16)
    paths = [tmp_path / "large.jpg", tmp_path / "large.png", tmp_path / "no_picture.jpg"]
    for path in paths[:2]:
        Image.new("RGB", (3840, 2560)).save(path)
    paths[2].write_bytes(b"")
    part, whole, none = (decoding_bytes(path, 1600) for path in paths)
    assert (part, whole, none) == (1920 * 1280 * 16, 3840 * 2560 * 16, 1)
    assert decoding_bytes(paths[0]) == whole
    assert [threads.n_threads(n) for n in (part, whole, none, 10 * whole)] == [8, 4, 8, 1]


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bits_take_no_more_memory_than_is_planned_for(channels: int, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((600, 800, channels), np.uint16))
    tracemalloc.start()
    read_picture(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < decoding_bytes(path)


def profile_like(primaries: list[tuple[float, float, float]]) -> bytes:
    """Return an ICC profile with sRGB's curves and other `primaries` (XYZ under D50 of red, green, blue)."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    (n_tags,) = struct.unpack_from(">I", profile, 128)
    tags = {bytes(profile[at : at + 4]): struct.unpack_from(">I", profile, at + 4)[0]
            for at in range(132, 132 + 12 * n_tags, 12)}  # fmt: skip
    for name, xyz in zip((b"rXYZ", b"gXYZ", b"bXYZ"), primaries, strict=True):
        struct.pack_into(">3i", profile, tags[name] + 8, *(round(65536 * value) for value in xyz))
    return bytes(profile).replace("sRGB".encode("utf-16-be"), "wide".encode("utf-16-be"))


DISPLAY_P3 = [(0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407)]
SRGB = [(0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.71410)]


def in_p3_and_srgb() -> tuple[Image.Image, np.ndarray]:
    """Return a picture whose numbers are Display P3, and the same colours in sRGB, [height, width, 3] int."""
    linear = np.random.default_rng(0).uniform(0.05, 0.6, (4, 5, 3))
    to_p3 = np.linalg.solve(np.array(DISPLAY_P3).T, np.array(SRGB).T)

    def encoded(colours: np.ndarray) -> np.ndarray:
        values = np.where(colours <= 0.0031308, 12.92 * colours, 1.055 * colours ** (1 / 2.4) - 0.055)
        return np.rint(255 * values.clip(0, 1)).astype(np.uint8).repeat(16, axis=0).repeat(16, axis=1)

    return Image.fromarray(encoded(linear @ to_p3.T)), encoded(linear).astype(int)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tif"])
def test_colours_of_another_profile_become_srgb(suffix: str, tmp_path: Path) -> None:
    """The same colours, written as Display P3 and as sRGB, are read as the same picture."""
    wide, srgb = in_p3_and_srgb()
    lossless = {"lossless": True} if suffix == ".webp" else {"quality": 100, "subsampling": 0}
    path = tmp_path / f"a{suffix}"
    wide.save(path, icc_profile=profile_like(DISPLAY_P3), **lossless)
    read = read_picture(path).astype(int)
    assert (read[..., 3] == 255).all()
    assert np.abs(read[..., :3] - srgb)[8::16, 8::16].max() <= (4 if suffix == ".jpg" else 2)
    assert np.abs(np.asarray(wide).astype(int) - srgb).max() > 8, "profiles would not matter"


@pytest.mark.parametrize("suffix", [".heic", ".avif"])
def test_colours_that_a_file_names_by_a_code_become_srgb(suffix: str, tmp_path: Path) -> None:
    """A HEIC or AVIF picture may name Display P3 by a number in place of a profile."""
    wide, srgb = in_p3_and_srgb()
    path = tmp_path / f"a{suffix}"
    wide.save(path, quality=100, chroma=444, subsampling="4:4:4")
    data, code = path.read_bytes(), b"colrnclx\0"
    place = data.index(code) + len(code)
    path.write_bytes(data[:place] + b"\x0c" + data[place + 1 :])
    read = read_picture(path).astype(int)[..., :3]
    assert np.abs(read - srgb)[8::16, 8::16].max() <= 4
    path.write_bytes(data[:place] + b"\1" + data[place + 1 :])
    assert np.abs(read_picture(path)[..., :3] - srgb)[8::16, 8::16].max() > 8, "it is taken as sRGB"


def test_a_picture_in_srgb_is_read_bit_for_bit(tmp_path: Path) -> None:
    colours = blots(40, 30)
    alpha = np.random.default_rng(1).integers(0, 256, (30, 40, 1), np.uint8)
    rgba = np.concatenate([colours, alpha], axis=-1)
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for name, profile in (("own", own), ("damaged", own[:200]), ("none", b"")):
        Image.fromarray(rgba).save(tmp_path / f"{name}.png", icc_profile=profile)
        assert np.array_equal(read_picture(tmp_path / f"{name}.png"), rgba)
    Image.fromarray(rgba).save(tmp_path / "wide.png", icc_profile=profile_like(DISPLAY_P3))
    wide = read_picture(tmp_path / "wide.png")
    assert np.array_equal(wide[..., 3:], alpha) and not np.array_equal(wide[..., :3], colours)


def test_a_copy_that_was_made_smaller_shows_the_same(tmp_path: Path) -> None:
    """The larger one is kept, however sharp the other is. A part of a picture is no copy of it."""
    whole = Image.fromarray(blots(640, 480, 16))
    pictures = [whole.resize((427, 320), Image.Resampling.LANCZOS), whole, whole.crop((80, 60, 560, 420))]
    for number, picture in enumerate(pictures):
        picture.save(tmp_path / f"{number}.png")
    paths = [(tmp_path / f"{number}.png", None) for number in range(3)]
    looks = look_at(paths, KeptMatches(tmp_path / "kept"), None)
    sizes = [(look.sensor.width, look.sensor.height) for look in looks]
    thumbnails = np.stack([look.thumbnail for look in looks])
    features = [look.features for look in looks]
    assert repeats(features, sizes, thumbnails, [3.0, 1.0, 2.0]) == {0: 1}
    rounded = [(639, 480), *sizes[1:]]
    assert repeats([features[1], *features[1:]], rounded, thumbnails[[1, 1, 2]], [3.0, 1.0, 2.0]) == {1: 0}
