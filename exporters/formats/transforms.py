"""Writer of a transforms.json with cameras in the frame of an export: instant-ngp's form, as
`player.cameras.transforms` writes it.

The axes of a camera (x right, y up, looks along -z) and its pixels are the same in every frame; only the
poses of the cameras change.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from player.cameras.camera import Camera
from player.cameras.transforms import parse_transforms, transforms_cameras, write_cameras
from player.errors import ParityError


def transforms_bytes(cameras: Sequence[Camera], matrix: np.ndarray, where: str) -> bytes:
    """Return the file of `cameras`, transformed to another frame, after reading it back.

    Args:
        cameras: at least one, world frame.
        matrix: [4, 4] similarity, as `exporters.formats.axes.coordinates_from_world` makes it.
        where: the file's name in an error message.

    Raises:
        ParityError: the bytes do not hold the cameras.

    >>> camera = Camera("a", np.eye(4), 4, 3, 5.0, 5.0, 2.0, 1.5)
    >>> b'"fl_x": 5.0' in transforms_bytes([camera], np.eye(4), "cameras.json")
    True
    """
    moved = moved_cameras(cameras, matrix)
    data = write_cameras(moved)
    check_cameras(moved, transforms_cameras(parse_transforms(data, where), where), where, 0.0)
    return data


def moved_cameras(cameras: Sequence[Camera], matrix: np.ndarray) -> list[Camera]:
    """Return the cameras in another frame; bit for bit the same ones where the matrix is the identity."""
    if np.array_equal(matrix, np.eye(4)):
        return list(cameras)
    return [camera.transformed(matrix) for camera in cameras]


def check_cameras(expected: Sequence[Camera], got: Sequence[Camera], where: str, tolerance: float) -> None:
    """Raise ParityError unless two lists of cameras agree: names and sizes exactly, numbers within
    `tolerance` of the largest number of their camera."""
    if len(expected) != len(got):
        raise ParityError(f"{where}: cameras: expected {len(expected)}, got {len(got)}")
    for a, b in zip(expected, got, strict=True):
        if (a.name, a.width, a.height) != (b.name, b.width, b.height):
            raise ParityError(
                f"{where}: camera: expected {a.name} {a.width}x{a.height}, got {b.name} {b.width}x{b.height}"
            )
        for name, left, right in (("pose", a.c2w, b.c2w), ("intrinsics", _lens(a), _lens(b))):
            worst = float(np.abs(left - right).max())
            if not worst <= tolerance * max(float(np.abs(left).max()), 1.0):
                raise ParityError(
                    f"{where}: {a.name}: {name}: {worst:g} apart, tolerance {tolerance:g}: "
                    f"expected {left.tolist()}, got {right.tolist()}"
                )


def _lens(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
