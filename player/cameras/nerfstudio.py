"""Reading and writing nerfstudio's `camera_path.json`.

The axes are those of `player.cameras.camera`. `fov` is the whole vertical field of view in degrees; a path
has one size for all pictures. nerfstudio moves and scales a scene before it trains, and records this in
`dataparser_transforms.json` beside its checkpoints. If that file lies beside the path, the transform is
undone. Without it, the path is taken to be in the photographs' world, as the paths that `vfr-play` saves are.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from player.cameras.camera import Camera
from player.cameras.transforms import MAX_FRAMES, MAX_PIXELS_A_SIDE
from player.errors import FormatError
from player.files.json_files import as_float, brief, parse_json, read_json

PLACEMENT = "dataparser_transforms.json"
LEAST_FPS, MOST_FPS = 0.001, 1000
"""Frames a second that a video can have."""
LEAST_SCALE = 1e-12
"""The least scale of a scene in nerfstudio's frame; the largest is its inverse. Matrices of others cannot be
inverted precisely."""


def is_camera_path(document: Any) -> bool:
    """Return whether a JSON document is a camera path and not a transforms.json."""
    return isinstance(document, dict) and "camera_path" in document


def path_cameras(document: dict[str, Any], path: Path) -> list[Camera]:
    """Return the cameras of a camera path that was read from `path`, world frame.

    Raises FormatError in one line: file, frame, expected, got.
    """
    kind = document.get("camera_type", "perspective")
    if kind != "perspective":
        raise FormatError(f"{path}: camera_type: expected perspective, got {brief(kind)}")
    width, height = (_size(document, key, path) for key in ("render_width", "render_height"))
    frames = document["camera_path"]
    if not isinstance(frames, list) or not frames:
        raise FormatError(f"{path}: camera_path: expected a list of at least one frame, got {brief(frames)}")
    if len(frames) > MAX_FRAMES:
        raise FormatError(f"{path}: camera_path: expected at most {MAX_FRAMES} frames, got {len(frames)}")
    world_from_path = _placement(path.parent / PLACEMENT)
    cameras = []
    for index, frame in enumerate(frames):
        where = f"{path}: frame {index}"
        if not isinstance(frame, dict):
            raise FormatError(f"{where}: expected an object, got {brief(frame)}")
        fov = as_float(frame.get("fov"))
        if fov is None or not 0 < fov < 180:
            raise FormatError(
                f"{where}: fov: expected degrees between 0 and 180, got {brief(frame.get('fov'))}"
            )
        focal = height / 2 / max(math.tan(math.radians(fov) / 2), 1e-300)  # keeps it finite
        c2w = _matrix(frame.get("camera_to_world"), where)
        camera = Camera(where, c2w, width, height, focal, focal, width / 2, height / 2)
        placed = camera if world_from_path is None else camera.transformed(world_from_path)
        cameras.append(replace(placed, name=f"frame_{index:05d}"))
    return cameras


def path_frame_rate(document: dict[str, Any], path: Path) -> float | None:
    """Return the frames per second of a camera path, None if it has none. Raises FormatError."""
    if document.get("fps") is None:
        return None
    fps = as_float(document["fps"])
    if fps is None or not LEAST_FPS <= fps <= MOST_FPS:
        raise FormatError(
            f"{path}: fps: expected {LEAST_FPS} to {MOST_FPS} frames a second, got {brief(document['fps'])}"
        )
    return fps


def write_camera_path(cameras: Sequence[Camera], fps: float) -> bytes:
    """Encode `cameras` as a camera_path.json; they must have one size, square pixels and a centred axis.

    >>> camera = Camera("a", np.eye(4), width=8, height=6, fx=9.0, fy=9.0, cx=4.0, cy=3.0)
    >>> document = json.loads(write_camera_path([camera], fps=30))
    >>> path_cameras(document, Path("path.json"))[0].fx
    9.0
    """
    frames = [
        {
            "camera_to_world": camera.c2w.reshape(-1).tolist(),
            "fov": math.degrees(2 * math.atan(camera.height / 2 / camera.fy)),
            "aspect": camera.width / camera.height,
        }
        for camera in cameras
    ]
    document = {
        "camera_type": "perspective",
        "render_width": cameras[0].width,
        "render_height": cameras[0].height,
        "fps": fps,
        "seconds": len(cameras) / fps,
        "camera_path": frames,
    }
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def _size(document: dict[str, Any], key: str, path: Path) -> int:
    number = as_float(document.get(key))
    if number is None or number != int(number) or not 1 <= number <= MAX_PIXELS_A_SIDE:
        raise FormatError(
            f"{path}: {key}: expected 1 to {MAX_PIXELS_A_SIDE} whole pixels, got {brief(document.get(key))}"
        )
    return int(number)


def _matrix(values: Any, where: str) -> np.ndarray:
    """Return [4, 4] float64 from 16 numbers row by row, or from 4 rows of 4."""
    if isinstance(values, list) and values and all(isinstance(row, list) for row in values):
        values = [value for row in values for value in row]
    if not isinstance(values, list) or len(values) != 16 or any(as_float(value) is None for value in values):
        raise FormatError(f"{where}: camera_to_world: expected 16 finite numbers, got {brief(values)}")
    return np.array(values, np.float64).reshape(4, 4)


def _placement(path: Path) -> np.ndarray | None:
    """Return the matrix [4, 4] from the path's frame to the world's, from a `dataparser_transforms.json`;
    None without the file.

    The file has everything that nerfstudio has done to the cameras as COLMAP found them, including the
    `applied_transform` of the data set's `transforms.json`. The world here is that of `transforms.json`, to
    which `applied_transform` has already been applied.
    """
    if not path.exists():
        return None
    document = parse_json(read_json(path, "nerfstudio's placement of the scene"), str(path))
    rows, scale = (
        document.get(key) if isinstance(document, dict) else None for key in ("transform", "scale")
    )
    factor = as_float(scale)
    if factor is None or factor <= 0 or not isinstance(rows, list) or len(rows) != 3:
        raise FormatError(f"{path}: expected a transform of 3 rows and a scale, got {brief(document)}")
    matrix = _matrix([*rows, [0, 0, 0, 1]], str(path))
    if not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-3):
        raise FormatError(f"{path}: transform: expected a rotation and a translation, got {brief(rows)}")
    applied, applied_factor = _applied(path.with_name("transforms.json"))
    ratio = factor / applied_factor
    if not LEAST_SCALE <= ratio <= 1 / LEAST_SCALE:
        raise FormatError(
            f"{path}: scale: expected {LEAST_SCALE} to {1 / LEAST_SCALE:.0e} times applied_scale, got {ratio}"
        )
    return applied @ np.linalg.inv(np.diag([ratio] * 3 + [1]) @ matrix)


def _applied(path: Path) -> tuple[np.ndarray, float]:
    """Read `applied_transform` [4, 4] and `applied_scale` of a `transforms.json`; without the file, the
    identity and 1."""
    document = parse_json(read_json(path, "nerfstudio's cameras"), str(path)) if path.exists() else {}
    if not isinstance(document, dict):
        raise FormatError(f"{path}: expected nerfstudio's cameras, got {brief(document)}")
    rows, factor = document.get("applied_transform"), as_float(document.get("applied_scale", 1.0))
    if factor is None or factor <= 0:
        raise FormatError(f"{path}: applied_scale: expected more than 0, got {brief(document)}")
    if rows is None:
        return np.eye(4), factor
    if not isinstance(rows, list) or len(rows) != 3:
        raise FormatError(f"{path}: applied_transform: expected 3 rows, got {brief(rows)}")
    return _matrix([*rows, [0, 0, 0, 1]], f"{path}: applied_transform"), factor
