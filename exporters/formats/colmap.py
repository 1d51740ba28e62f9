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
from typing import NamedTuple

import numpy as np

from exporters.formats.transforms import check_cameras
from exporters.shapes.mesh import TriangleMesh
from player.cameras.camera import Camera
from player.cameras.colmap import MAX_FILE_BYTES
from player.cameras.rotations import OPENGL_FROM_OPENCV, quaternion, rotation_matrix
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


class _Image(NamedTuple):
    """A picture of a model."""

    pose: list[float]
    """Quaternion (w, x, y, z) and translation of the transform camera from world."""
    lens: int
    """The number of its COLMAP camera."""
    name: str


class _Model(NamedTuple):
    """What the three files of a model hold."""

    lenses: dict[int, tuple[float, ...]]
    """Width, height, fx, fy, cx, cy of each COLMAP camera, by its number."""
    images: list[_Image]
    places: np.ndarray
    """[n_points, 3] float64."""
    colours: np.ndarray
    """[n_points, 3] sRGB, 0 to 255."""


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
    files = _written(_model(cameras, cloud))
    _check(_parsed(files), cameras, cloud)
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


def _model(cameras: Sequence[Camera], cloud: TriangleMesh) -> _Model:
    lenses: dict[tuple[float, ...], int] = {}
    images = []
    for camera in cameras:
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        lens_id = lenses.setdefault(lens, len(lenses) + 1)
        w2c = np.linalg.inv(_rigid(camera).c2w @ OPENGL_FROM_OPENCV)
        images.append(_Image([*quaternion(w2c[:3, :3]), *w2c[:3, 3]], lens_id, _name(camera)))
    by_number = {number: lens for lens, number in lenses.items()}
    return _Model(by_number, images, cloud.vertices.astype(np.float64), cloud.colours[:, :3])


def _rigid(camera: Camera) -> Camera:
    """Return the camera as COLMAP can hold it: with COLMAP's name and the rotation nearest to its own."""
    u, _, v = np.linalg.svd(camera.c2w[:3, :3])
    c2w = camera.c2w.copy()
    c2w[:3, :3] = u @ v
    return replace(camera, name=_name(camera), c2w=c2w)


def _name(camera: Camera) -> str:
    name = camera.name.replace("\\", "/").removeprefix("./")
    return name if PurePosixPath(name).suffix else f"{name}.png"


def _written(model: _Model) -> dict[str, bytes]:
    lenses = np.zeros(len(model.lenses), _LENS)
    numbers = np.array(list(model.lenses.values()), np.float64)
    lenses["id"], lenses["model"] = list(model.lenses), _PINHOLE
    lenses["size"], lenses["parameters"] = numbers[:, :2], numbers[:, 2:]
    images = [
        _IMAGE.pack(number, *image.pose, image.lens) + image.name.encode() + b"\0" + _COUNT.pack(0)
        for number, image in enumerate(model.images, start=1)
    ]
    points = np.zeros(len(model.places), _POINT)
    points["id"] = np.arange(1, len(points) + 1)
    points["place"], points["colour"] = model.places, model.colours
    cameras_file, images_file, points_file = FILES
    return {
        cameras_file: _COUNT.pack(len(lenses)) + lenses.tobytes(),
        images_file: _COUNT.pack(len(images)) + b"".join(images),
        points_file: _COUNT.pack(len(points)) + points.tobytes(),
    }


def _parsed(files: dict[str, bytes]) -> _Model:
    lens_data, image_data, point_data = (files[name] for name in FILES)
    n_lenses, n_images, n_points = (
        _COUNT.unpack_from(data)[0] for data in (lens_data, image_data, point_data)
    )
    lenses = {
        int(lens["id"]): (*lens["size"].tolist(), *lens["parameters"].tolist())
        for lens in np.frombuffer(lens_data, _LENS, n_lenses, _COUNT.size)
    }
    images, at = [], _COUNT.size
    for _ in range(n_images):
        _, *pose, lens = _IMAGE.unpack_from(image_data, at)
        at += _IMAGE.size
        end = image_data.index(b"\0", at)
        images.append(_Image(pose, lens, image_data[at:end].decode()))
        at = end + 1 + _COUNT.size
    points = np.frombuffer(point_data, _POINT, n_points, _COUNT.size)
    return _Model(lenses, images, points["place"], points["colour"])


def _check(read: _Model, cameras: Sequence[Camera], cloud: TriangleMesh) -> None:
    """Raise ParityError unless the model that was read back holds the cameras and the points."""
    found = []
    for image in read.images:
        w2c = np.eye(4)
        w2c[:3, :3] = rotation_matrix(np.array(image.pose[:4]))
        w2c[:3, 3] = image.pose[4:]
        width, height, *lens = read.lenses[image.lens]
        c2w = np.linalg.inv(w2c) @ OPENGL_FROM_OPENCV
        found.append(Camera(image.name, c2w, int(width), int(height), *lens))
    check_cameras([_rigid(camera) for camera in cameras], found, FILES[1], TOLERANCE)
    expected = (cloud.vertices, cloud.colours[:, :3])
    if not all(map(np.array_equal, expected, (read.places, read.colours))):
        n_expected, n_read = len(cloud.vertices), len(read.places)
        raise ParityError(f"{FILES[2]}: expected {n_expected} points as sampled, got {n_read} others")
