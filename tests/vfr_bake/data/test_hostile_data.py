"""Data sets with things that are no files, or are far larger than they seem, are refused in one line at once.
Links are as good as files."""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from player.cameras.views import read_views
from player.errors import DataError, FormatError
from vfr_bake.data import load_scene
from vfr_bake.data.files.pictures import read_picture
from vfr_bake.data.poses import estimate_cameras


def png(width: int, height: int, bits: int = 8, colour: int = 2) -> bytes:
    """Return the beginning of a picture whose header states this size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1 << 20)))


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


def large(path: Path) -> None:
    path.write_bytes(png(100_000, 100_000))


def large_16_bit(path: Path) -> None:
    path.write_bytes(png(100_000, 100_000, bits=16))


def postscript(path: Path) -> None:
    """Write a PostScript file, for which Pillow would start Ghostscript."""
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 32\n%%EndComments\nshowpage\n")


@pytest.fixture
def data(small_data: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_data, tmp_path / "data"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (pipe, "picture is missing"),
        (device, "picture is missing"),
        (huge, "size: expected at most 1073741824 bytes for a picture"),
        (large, "picture: cannot be read to its end: Image size"),
        (large_16_bit, "picture: cannot be read to its end: Image size"),
        (postscript, "picture: expected JPEG, PNG, AVIF, WEBP, TIFF or BMP, got something else"),
    ],
)
def test_pictures(make: Callable[[Path], None], message: str, data: Path) -> None:
    path = data / "train" / "r_2.png"
    path.unlink()
    make(path)
    with pytest.raises(DataError, match=message) as caught:
        load_scene(data)
    assert "\n" not in str(caught.value) and "r_2" in str(caught.value)
    with pytest.raises(DataError):
        read_picture(path)


def test_links_to_pictures_and_cameras(data: Path, tmp_path: Path) -> None:
    away = tmp_path / "away"
    away.mkdir()
    for path in [data / "transforms_train.json", *(data / "train").iterdir()]:
        path.rename(away / path.name)
        path.symlink_to(away / path.name)
    assert len(load_scene(data).train.images) == 12


@pytest.mark.parametrize("make", [pipe, device, huge])
@pytest.mark.parametrize("name", ["transforms_train.json", "sparse/0/images.bin", "sparse/0/cameras.bin"])
def test_cameras(name: str, make: Callable[[Path], None], data: Path) -> None:
    if name.startswith("sparse"):
        (data / "transforms_train.json").unlink()
        (data / "sparse" / "0").mkdir(parents=True)
        for other in ("images.bin", "cameras.bin"):
            (data / "sparse" / "0" / other).write_bytes(struct.pack("<Q", 0))
    path = data / name
    path.unlink()
    make(path)
    with pytest.raises(
        (DataError, FormatError), match=f"{path}: (size: expected|cannot read: expected a file)"
    ):
        load_scene(data)
    with pytest.raises(FormatError, match=f"{path}: (size: expected|cannot read: expected a file)"):
        read_views(path)


def test_a_track_that_is_longer_than_any_file(tmp_path: Path) -> None:
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.bin").write_bytes(b"")
    (model / "images.bin").write_bytes(struct.pack("<Q", 3))
    (model / "points3D.bin").write_bytes(struct.pack("<Q35xdQ", 2, 0.5, 1 << 62))
    with pytest.raises(FormatError, match="cut short: remove"):
        estimate_cameras(tmp_path, lambda *_: None)


def test_json_of_many_values(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_bytes(b'{"frames": [' + b"{}," * (9 << 20) + b"{}]}")
    with pytest.raises(FormatError, match="expected at most 8388608 values in JSON, got about"):
        read_views(path)
