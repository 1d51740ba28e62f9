"""Reading and writing the cameras of a transforms.json, and file names for its frames.

The axes and pixel conventions of the file are those of `player.cameras.camera`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from player.cameras.camera import Camera
from player.errors import FormatError
from player.files.json_files import as_float, brief, parse_json, read_json

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr")
MAX_PIXELS_A_SIDE = 65536
MAX_FRAMES = 100_000
"""The most frames of a file of cameras: reading so many takes seconds."""
MAX_PATH = 4096
"""The most characters of a `file_path`: no system opens longer ones."""
MAX_NAME_PARTS = 16
"""The most folders and stem that become the name of a frame's file."""
_UNWRITABLE = re.compile("[\0-\x1f\x7f\x85\u2028\u2029\ud800-\udfff]")
"""Characters that cannot be in a file name: control characters, line ends and halves of surrogate pairs."""
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Keys of OpenCV's coefficients of lens distortion."""
PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL")


def load_transforms(path: str | Path) -> dict[str, Any]:
    """Read the JSON of a transforms.json, and check that `frames` is a list of objects that each have a
    `file_path`.

    Raises FormatError: no such file, over 64 MB, not JSON (NaN and Infinity are not), no frames, not a
    pinhole model.
    """
    data = read_json(path, "a transforms.json")
    return parse_transforms(data, str(path))


def parse_transforms(data: bytes, where: str) -> dict[str, Any]:
    """Parse the JSON of a transforms.json from the file's bytes, and check it as `load_transforms` does.

    `where` names the file in messages.

    >>> parse_transforms(b'{"frames": []}', "cameras")
    Traceback (most recent call last):
    player.errors.FormatError: cameras: frames: expected a list of at least one frame, got []
    """
    document = parse_json(data, where)
    if not isinstance(document, dict):
        raise FormatError(f"{where}: expected a JSON object with frames, got {brief(document)}")
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        raise FormatError(f"{where}: frames: expected a list of at least one frame, got {brief(frames)}")
    if len(frames) > MAX_FRAMES:
        raise FormatError(f"{where}: frames: expected at most {MAX_FRAMES}, got {len(frames)}")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise FormatError(f"{where}: frame {index}: expected an object, got {brief(frame)}")
        name = frame.get("file_path")
        if not isinstance(name, str) or not name or _UNWRITABLE.search(name):
            raise FormatError(f"{where}: frame {index}: file_path: expected a path, got {brief(name)}")
        if len(name) > MAX_PATH:
            raise FormatError(
                f"{where}: frame {index}: file_path: expected at most {MAX_PATH} characters, got {len(name)}"
            )
        place = f"{where}: frame {index} ({brief(name)})"
        model = frame.get("camera_model", document.get("camera_model", "PINHOLE"))
        if model not in PINHOLE_MODELS:
            expected = ", ".join(PINHOLE_MODELS)
            raise FormatError(f"{place}: camera_model: expected one of {expected}, got {brief(model)}")
        if frame.get("is_fisheye", document.get("is_fisheye", False)):
            raise FormatError(f"{place}: is_fisheye: expected a pinhole camera, got a fisheye")
    return document


def read_cameras(path: str | Path, size: tuple[int, int] | None = None) -> list[Camera]:
    """Read the cameras of a transforms.json, in the NeRF-synthetic, the instant-ngp or the nerfstudio form.

    `path`: the file. `size`: (width, height) in pixels of cameras for which the file has no `w`, `h`.

    The focal length is `fl_x`, `fl_y` in pixels, or else follows from `camera_angle_x`, `camera_angle_y`, the
    whole field of view in radians. A key inside a frame takes precedence over the same key at the top. A
    matrix of three rows is completed. Lens distortion (`k1`, ...) is not part of a camera: pictures are
    undistorted when they are read, and the cameras returned are those of the undistorted pictures.

    Raises FormatError in one line: file, frame, expected, got.

    >>> import tempfile
    >>> camera = Camera("a.png", np.eye(4), width=8, height=6, fx=9.0, fy=9.0, cx=4.0, cy=3.0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "transforms.json"
    ...     _ = path.write_bytes(write_cameras([camera]))
    ...     [(c.name, c.width, c.fx) for c in read_cameras(path)]
    [('a.png', 8, 9.0)]
    """
    document = load_transforms(path)
    return transforms_cameras(document, path, [size] * len(document["frames"]))


def transforms_cameras(
    document: dict[str, Any], where: Path | str, sizes: Sequence[tuple[int, int] | None] | None = None
) -> list[Camera]:
    """Return the cameras of what `load_transforms` returned. `where` names the file in messages; `sizes` are
    the (width, height) of frames that have none. Raises FormatError."""
    frames = document["frames"]
    return [
        _frame_camera(document, frame, f"{where}: frame {index} ({brief(frame['file_path'])})", size)
        for index, (frame, size) in enumerate(zip(frames, sizes or [None] * len(frames), strict=True))
    ]


def is_distorted(document: dict[str, Any], frame: dict[str, Any]) -> bool:
    """Return whether the camera of a frame has lens distortion: a coefficient, its own or that at the top of
    the document, that is not 0.

    >>> is_distorted({"k1": 0.1}, {"k1": 0}), is_distorted({"k1": 0.1}, {})
    (False, True)
    """
    return any(frame.get(key, document.get(key)) for key in DISTORTION)


def transforms_number(document: dict[str, Any], frame: dict[str, Any], key: str, where: str) -> float | None:
    """Return the finite number `key` of the frame, else of the top of the document, else None. Raises
    FormatError."""
    value = frame.get(key, document.get(key))
    if value is None:
        return None
    number = as_float(value)
    if number is None:
        raise FormatError(f"{where}: {key}: expected a finite number, got {brief(repr(value))}")
    return number


def write_cameras(cameras: Sequence[Camera]) -> bytes:
    """Encode `cameras` as a transforms.json, each frame with its own `fl_x fl_y cx cy w h` (instant-ngp
    form).

    >>> camera = Camera("a.png", np.eye(4), width=8, height=6, fx=9.0, fy=9.0, cx=4.0, cy=3.0)
    >>> json.loads(write_cameras([camera]))["frames"][0]["w"]
    8
    """
    frames = [
        {
            "file_path": camera.name,
            "w": int(camera.width),
            "h": int(camera.height),
            "fl_x": float(camera.fx),
            "fl_y": float(camera.fy),
            "cx": float(camera.cx),
            "cy": float(camera.cy),
            "transform_matrix": np.asarray(camera.c2w, np.float64).tolist(),
        }
        for camera in cameras
    ]
    return (json.dumps({"frames": frames}, indent=1, allow_nan=False) + "\n").encode()


def frame_names(cameras: Sequence[Camera]) -> list[str]:
    """Return a file stem for each camera, all different on any file system, without separators.

    Cameras that share a stem get the names of their innermost folders put before it, joined with `_`, and a
    running number if that is not enough.

    >>> pose = np.eye(4)
    >>> names = ["./test/r_0", "images/0001.jpg", "left/a.png", "right/a.png", "right/a.png"]
    >>> frame_names([Camera(name, pose, 1, 1, 1.0, 1.0, 0.5, 0.5) for name in names])
    ['r_0', '0001', 'left_a', 'right_a', 'right_a_1']
    """
    parts = [_name_parts(camera.name) for camera in cameras]
    depth = [1] * len(parts)

    def name_of(i: int) -> str:
        return "_".join(parts[i][-depth[i] :])

    deeper = True
    while deeper:
        deeper = False
        groups: dict[str, list[int]] = {}
        for i in range(len(parts)):
            groups.setdefault(name_of(i).casefold(), []).append(i)
        for group in groups.values():
            for i in group if len(group) > 1 else []:
                if depth[i] < len(parts[i]):
                    depth[i] += 1
                    deeper = True
    names = [name_of(i) for i in range(len(parts))]
    taken = {name.casefold() for name in names}
    numbers: dict[str, int] = {}  # the last number that was tried for a name
    for i, name in enumerate(names):
        key = name.casefold()
        number = numbers.get(key)
        while number is not None and names[i].casefold() in taken:
            number += 1
            names[i] = f"{name}_{number}"
        numbers[key] = number or 0
        taken.add(names[i].casefold())
    return names


def _frame_camera(
    document: dict[str, Any], frame: dict[str, Any], where: str, size: tuple[int, int] | None
) -> Camera:
    width, height = (_pixels(document, frame, key, where) for key in ("w", "h"))
    if width is None or height is None:
        if size is None:
            raise FormatError(f"{where}: w, h: expected the picture's size, got none: pass a size")
        width, height = size
    fx, fy = (
        _focal(document, frame, axis, n_pixels, where) for axis, n_pixels in (("x", width), ("y", height))
    )
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    if fx is None or fy is None:
        raise FormatError(f"{where}: focal length: expected fl_x or camera_angle_x, got neither")
    cx, cy = (transforms_number(document, frame, key, where) for key in ("cx", "cy"))
    try:
        return Camera(
            name=frame["file_path"],
            c2w=_matrix(frame.get("transform_matrix")),
            width=width,
            height=height,
            fx=fx,
            fy=fy,
            cx=width / 2 if cx is None else cx,
            cy=height / 2 if cy is None else cy,
        )
    except FormatError as error:
        message = str(error).removeprefix(f"{frame['file_path']}: ")
        raise FormatError(f"{where}: {message}") from None


def _focal(
    document: dict[str, Any], frame: dict[str, Any], axis: str, n_pixels: int, where: str
) -> float | None:
    """Return the focal length along `axis` in pixels, given as such or by an angle. The frame's takes
    precedence over the top's."""
    for level in (frame, document):
        focal = transforms_number({}, level, f"fl_{axis}", where)
        if focal is not None:
            return focal
        angle = transforms_number({}, level, f"camera_angle_{axis}", where)
        if angle is not None:
            if not 0 < angle < np.pi:
                raise FormatError(
                    f"{where}: camera_angle_{axis}: expected radians between 0 and pi, got {angle}"
                )
            return float(0.5 * n_pixels / max(np.tan(0.5 * angle), 1e-300))  # keeps it finite
    return None


def _pixels(document: dict[str, Any], frame: dict[str, Any], key: str, where: str) -> int | None:
    number = transforms_number(document, frame, key, where)
    if number is None:
        return None
    if number != int(number) or not 1 <= number <= MAX_PIXELS_A_SIDE:
        raise FormatError(f"{where}: {key}: expected 1 to {MAX_PIXELS_A_SIDE} whole pixels, got {number}")
    return int(number)


def _matrix(rows: Any) -> np.ndarray:
    """Return the rows of a `transform_matrix` as [4, 4] float64; three rows are completed."""
    expected = "camera matrix: expected 4 rows of 4 numbers"
    if not isinstance(rows, list):
        raise FormatError(f"{expected}, got {brief(rows)}")
    if len(rows) not in (3, 4):
        raise FormatError(f"{expected}, got {len(rows)} rows")
    for index, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != 4 or any(as_float(value) is None for value in row):
            raise FormatError(f"{expected}, got row {index}: {brief(row)}")
    return np.array([*rows, [0, 0, 0, 1]][:4], np.float64)


def _name_parts(name: str) -> list[str]:
    """Return the innermost folders and the stem of a picture's path, made fit for file names on any
    system."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".", "..")]
    parts = parts[-MAX_NAME_PARTS:]
    if parts and parts[-1].lower().endswith(PICTURE_SUFFIXES):
        parts[-1] = parts[-1].rpartition(".")[0]
    safe = ["".join(c if c.isprintable() and c not in '<>:"|?*' else "_" for c in part) for part in parts]
    safe = [part.rstrip(". ").replace("..", "_") for part in safe]
    return [part for part in safe if part] or ["frame"]
