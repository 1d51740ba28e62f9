"""Writer of a COLMAP model, for Gaussian splatting.

The files are COLMAP's binary form, `cameras.bin`, `images.bin` and `points3D.bin`. Not every program reads
COLMAP's text, whose readers also end the name of a picture at its first space.

A COLMAP camera looks along +z with y down (OpenCV). A picture's pose is the transform camera from world, as a
quaternion (w, x, y, z) and a translation. Pixel centres are at +0.5, as in this project. Pictures have no
keypoints and points have no tracks, because the asset does not keep them. The points lie on the surface, and
their ERROR is 0.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from exporters.formats.transforms import check_cameras
from exporters.shapes.mesh import TriangleMesh
from player.cameras.camera import Camera
from player.cameras.colmap import MAX_FILE_BYTES, camera_of, parse_cameras, parse_images
from player.cameras.rotations import OPENGL_FROM_OPENCV, quaternion
from player.errors import FormatError, ParityError
from player.files.files import read_bytes

FILES = ("cameras.bin", "images.bin", "points3D.bin")
TOLERANCE = 1e-9
"""Largest relative difference of a camera read back: poses go through a quaternion and back, in float64."""

# The binary files are little-endian; each begins with the number of its entries.
_COUNT = struct.Struct("<Q")
_LENS = np.dtype([("id", "<u4"), ("model", "<i4"), ("size", "<u8", 2), ("parameters", "<f8", 4)])
_PINHOLE = 1  # COLMAP's number of the camera model PINHOLE
_IMAGE = struct.Struct("<I7dI")  # number, pose and lens; then the name, a zero byte and a count of keypoints
_POINT = np.dtype(
    [("id", "<u8"), ("place", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("track_length", "<u8")]
)


def colmap_files(cameras: Sequence[Camera], cloud: TriangleMesh) -> dict[str, bytes]:
    """Return the three files, by name, after reading them back and comparing them.

    Args:
        cameras: at least one, in the frame of the export; those of equal lens and size share a COLMAP camera.
            A leading `./` of their names is dropped: COLMAP's names are relative to the folder of pictures.
            Names without a suffix, as NeRF-synthetic has them for PNG files, get `.png`: other programs open
            the files by these names.
            A matrix that is only nearly a rotation (float32 files) is replaced by the nearest rotation.
        cloud: points in the same frame; its normals and faces are not used.

    Raises:
        ParityError: the files do not hold the cameras or the points.

    >>> none = np.zeros((0, 3))
    >>> empty = TriangleMesh(none, np.zeros((0, 3), np.int32), none, np.zeros((0, 4), np.uint8))
    >>> camera = Camera("./a.png", np.eye(4), 4, 3, 5.0, 5.0, 2.0, 1.5)
    >>> list(colmap_files([camera], empty))
    ['cameras.bin', 'images.bin', 'points3D.bin']
    """
    rigid = [_rigid(camera) for camera in cameras]
    files = _written(rigid, cloud)
    _check(files, rigid, cloud)
    return files


def is_model_file(path: Path) -> bool:
    """Return whether a file is one of a model that was written here.

    The files have no room for a mark: they count as written here if they have what this writer gives them,
    numbers 1, 2, ..., pinhole cameras, pictures without keypoints, and points without tracks or errors.
    """
    if path.name not in FILES:
        return False
    try:
        data = read_bytes(path, "a COLMAP model", MAX_FILE_BYTES)
    except FormatError:  # a folder, or not readable
        return False
    if path.name == "images.bin":
        return _has_no_keypoints(data)
    kind, column, value = (_LENS, "model", _PINHOLE) if path.name == "cameras.bin" else (_POINT, "error", 0)
    n, rest = divmod(len(data) - _COUNT.size, kind.itemsize)
    if n < 1 or rest or _COUNT.unpack_from(data)[0] != n:  # other lenses, or tracks, make entries longer
        return False
    rows = np.frombuffer(data, kind, n, _COUNT.size)
    return bool((rows["id"] == np.arange(1, n + 1)).all() and (rows[column] == value).all())


def _has_no_keypoints(data: bytes) -> bool:
    """Return whether the content of an `images.bin` is as `_written` has it."""
    try:
        at = _COUNT.size
        (n_images,) = _COUNT.unpack_from(data)
        for number in range(1, n_images + 1):
            found = _IMAGE.unpack_from(data, at)[0]
            at = data.index(b"\0", at + _IMAGE.size) + 1
            if found != number or _COUNT.unpack_from(data, at)[0]:
                return False
            at += _COUNT.size
    except (struct.error, ValueError):  # cut short
        return False
    return at == len(data)


def _rigid(camera: Camera) -> Camera:
    """Return the camera as COLMAP can hold it: with COLMAP's name and the rotation nearest to its own."""
    u, _, v = np.linalg.svd(camera.c2w[:3, :3])
    c2w = camera.c2w.copy()
    c2w[:3, :3] = u @ v
    return replace(camera, name=_name(camera), c2w=c2w)


def _name(camera: Camera) -> str:
    name = camera.name.replace("\\", "/").removeprefix("./")
    return name if PurePosixPath(name).suffix else f"{name}.png"


def _written(cameras: Sequence[Camera], cloud: TriangleMesh) -> dict[str, bytes]:
    numbers: dict[tuple[float, ...], int] = {}
    images = []
    for number, camera in enumerate(cameras, start=1):
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        lens_number = numbers.setdefault(lens, len(numbers) + 1)
        w2c = np.linalg.inv(camera.c2w @ OPENGL_FROM_OPENCV)
        image = _IMAGE.pack(number, *quaternion(w2c[:3, :3]), *w2c[:3, 3], lens_number)
        images.append(image + camera.name.encode() + b"\0" + _COUNT.pack(0))
    rows = np.array(list(numbers), np.float64)
    lenses = np.zeros(len(rows), _LENS)
    lenses["id"], lenses["model"] = list(numbers.values()), _PINHOLE
    lenses["size"], lenses["parameters"] = rows[:, :2], rows[:, 2:]
    points = np.zeros(len(cloud.vertices), _POINT)
    points["id"] = np.arange(1, len(points) + 1)
    points["place"], points["colour"] = cloud.vertices, cloud.colours[:, :3]
    cameras_file, images_file, points_file = FILES
    return {
        cameras_file: _COUNT.pack(len(lenses)) + lenses.tobytes(),
        images_file: _COUNT.pack(len(images)) + b"".join(images),
        points_file: _COUNT.pack(len(points)) + points.tobytes(),
    }


def _check(files: dict[str, bytes], cameras: Sequence[Camera], cloud: TriangleMesh) -> None:
    """Raise ParityError unless the files hold the cameras and the points."""
    cameras_file, images_file, points_file = FILES
    lenses = parse_cameras(files[cameras_file], cameras_file)
    images = parse_images(files[images_file], images_file)
    check_cameras(
        cameras, [camera_of(image, lenses[image.camera_id]) for image in images], images_file, TOLERANCE
    )
    points = np.frombuffer(files[points_file], _POINT, offset=_COUNT.size)
    expected = (cloud.vertices, cloud.colours[:, :3])
    if not all(map(np.array_equal, expected, (points["place"], points["colour"]))):
        raise ParityError(
            f"{points_file}: expected {len(cloud.vertices)} points as sampled, got {len(points)} others"
        )
