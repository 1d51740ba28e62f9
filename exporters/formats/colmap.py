"""Writer of a COLMAP model as text (`cameras.txt`, `images.txt`, `points3D.txt`), for Gaussian splatting and
multi-view stereo.

A COLMAP camera looks along +z with y down (OpenCV). A picture's pose is the transform camera from world, as a
quaternion (w, x, y, z) and a translation. Pixel centres are at +0.5, as in this project. Pictures have no
keypoints and points have no tracks, because the asset does not keep them. The points lie on the surface, and
their ERROR is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from exporters.formats.transforms import check_cameras
from exporters.shapes.mesh import TriangleMesh
from player.cameras.camera import Camera
from player.cameras.rotations import OPENGL_FROM_OPENCV, quaternion, rotation_matrix
from player.errors import ParityError

COLMAP_FILES = ("cameras.txt", "images.txt", "points3D.txt")
"""The names of a model's files."""
TOLERANCE = 1e-9
"""Largest relative difference of a camera read back: poses go through a quaternion and back, in float64."""


def colmap_files(cameras: Sequence[Camera], cloud: TriangleMesh) -> dict[str, bytes]:
    """Return the three files, by name, after reading them back and comparing them.

    Args:
        cameras: at least one, in the frame of the export; those of equal lens and size share a COLMAP camera.
            A leading `./` of their names is dropped: COLMAP's names are relative to the folder of pictures.
            A matrix that is only nearly a rotation (float32 files) is replaced by the nearest rotation.
        cloud: points in the same frame; its normals and faces are not used.

    Raises:
        ParityError: the text does not hold the cameras or the points.

    >>> none = np.zeros((0, 3))
    >>> empty = TriangleMesh(none, np.zeros((0, 3), np.int32), none, np.zeros((0, 4), np.uint8))
    >>> camera = Camera("./a.png", np.eye(4), 4, 3, 5.0, 5.0, 2.0, 1.5)
    >>> colmap_files([camera], empty)["images.txt"].decode().splitlines()[-2]
    '1 0.0 1.0 0.0 0.0 0.0 0.0 0.0 1 a.png'
    """
    lenses: dict[tuple[float, ...], int] = {}
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of keypoints (none)"]
    for number, camera in enumerate(cameras, start=1):
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        lens_id = lenses.setdefault(lens, len(lenses) + 1)
        w2c = np.linalg.inv(_rigid(camera).c2w @ OPENGL_FROM_OPENCV)
        pose = _numbers([*quaternion(w2c[:3, :3]), *w2c[:3, 3]])
        images += [f"{number} {pose} {lens_id} {_name(camera)}", ""]
    heads = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy"]
    heads += [f"{i} PINHOLE {lens[0]} {lens[1]} {_numbers(lens[2:])}" for lens, i in lenses.items()]
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, then its track (none)"]
    points += [
        f"{number} {_numbers(place)} {red} {green} {blue} 0"
        for number, (place, (red, green, blue)) in enumerate(
            zip(cloud.vertices.tolist(), cloud.colours[:, :3].tolist(), strict=True), start=1
        )
    ]
    files = {
        name: ("\n".join(lines) + "\n").encode()
        for name, lines in zip(COLMAP_FILES, (heads, images, points), strict=True)
    }
    _check(files, cameras, cloud)
    return files


def _rigid(camera: Camera) -> Camera:
    """Return the camera as COLMAP can hold it: with COLMAP's name and the rotation nearest to its own."""
    u, _, v = np.linalg.svd(camera.c2w[:3, :3])
    c2w = camera.c2w.copy()
    c2w[:3, :3] = u @ v
    return replace(camera, name=_name(camera), c2w=c2w)


def _name(camera: Camera) -> str:
    return camera.name.replace("\\", "/").removeprefix("./")


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)


def _check(files: dict[str, bytes], cameras: Sequence[Camera], cloud: TriangleMesh) -> None:
    """Parse the text again; raise ParityError unless it holds the cameras and the points."""
    heads, images, points = (
        [line for line in files[name].decode().split("\n")[1:-1] if line] for name in COLMAP_FILES
    )
    lenses = {int(words[0]): words for words in map(str.split, heads)}
    read = []
    for line in images:
        words = line.split(" ", 9)
        w2c = np.eye(4)
        w2c[:3, :3] = rotation_matrix(np.array(words[1:5], np.float64))
        w2c[:3, 3] = np.array(words[5:8], np.float64)
        lens = lenses[int(words[8])]
        c2w = np.linalg.inv(w2c) @ OPENGL_FROM_OPENCV
        fx, fy, cx, cy = map(float, lens[4:])
        read.append(Camera(words[9], c2w, int(lens[2]), int(lens[3]), fx, fy, cx, cy))
    check_cameras([_rigid(camera) for camera in cameras], read, "images.txt", TOLERANCE)
    rows = np.array([line.split() for line in points], np.float64).reshape(-1, 8)
    expected = np.concatenate([cloud.vertices.astype(np.float64), cloud.colours[:, :3]], axis=1)
    if rows.shape[0] != len(expected) or not np.array_equal(rows[:, 1:7], expected):
        raise ParityError(f"points3D.txt: expected {len(expected)} points as sampled, got {len(rows)} others")
