"""COLMAP models: `sparse/0/cameras.bin`, `images.bin` and `points3D.bin` beside the pictures.

The format is COLMAP's (scene/reconstruction_io.cc); it is read here because pycolmap's reader takes files
that were cut short for whole ones or never comes back from them. COLMAP's cameras look along +z with y down
(OpenCV); the pixel centre is at +0.5 as here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from player.cameras import Camera
from player.errors import DataError, FormatError
from vfr_bake.data.capture import Capture, counter, held_out
from vfr_bake.data.pictures import read_pictures

MODELS = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
}
"""Number, name and parameters of the camera models that are a pinhole behind OpenCV's lens."""
FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one camera, and the lens in front of it."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: dict[str, float]


@dataclass(frozen=True)
class RegisteredImage:
    """One picture that COLMAP has placed."""

    name: str
    camera_id: int
    c2w: np.ndarray
    """[4, 4], OpenGL axes."""


def colmap_folder(folder: Path) -> Path | None:
    """The folder of the COLMAP model that belongs to the pictures in `folder`, if there is one."""
    for name in FOLDERS:
        if (folder / name / "images.bin").exists():
            return folder / name
    return None


def load_colmap_folder(folder: Path, progress: Callable[[int, int], object] | None = None) -> Capture:
    """The pictures of `folder` that its COLMAP model has registered, in the order of their names.

    Pictures are looked for in `images/` and in the folder itself; every eighth is held out. Raises DataError
    (pictures, camera models) or FormatError (the model's files), in one line that names the file.
    """
    model = colmap_folder(folder)
    assert model is not None
    lenses = read_cameras(model / "cameras.bin")
    registered = sorted(read_images(model / "images.bin"), key=lambda image: image.name)
    if len(registered) < 2:
        raise DataError(f"{model}: registered pictures: expected at least 2, got {len(registered)}")
    points_file = model / "points3D.bin"
    points = read_points(points_file) if points_file.exists() else None
    paths, cameras, distortions = [], [], []
    for image in registered:
        if image.camera_id not in lenses:
            raise FormatError(f"{model}: {image.name}: camera {image.camera_id} is not in cameras.bin")
        lens = lenses[image.camera_id]
        paths.append(_picture_path(folder, image.name))
        cameras.append(
            Camera(image.name, image.c2w, lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
        )
        distortions.append(lens.distortion)
    views = read_pictures(paths, cameras, distortions, counter(len(paths), progress))
    train, test = held_out(views)
    return Capture(folder.resolve().name or "scene", train, test, points)


def read_cameras(path: Path) -> dict[int, Lens]:
    """The lenses of `cameras.bin` by camera number. Raises FormatError, DataError (an unknown model)."""
    file = _Reader(path)
    lenses = {}
    for _ in range(file.count(24)):
        camera_id, model, width, height = file.take("<iiQQ")
        if model not in MODELS:
            known = ", ".join(name for name, _ in MODELS.values())
            raise DataError(
                f"{path}: camera {camera_id}: model: expected {known}, got number {model}: "
                "undistort the pictures with COLMAP's image_undistorter first"
            )
        names = MODELS[model][1]
        values = dict(zip(names, file.take(f"<{len(names)}d"), strict=True))
        fx, fy = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
        if not (np.isfinite(list(values.values())).all() and fx > 0 and fy > 0):
            raise FormatError(
                f"{path}: camera {camera_id}: expected finite numbers and a positive focal length, "
                f"got {values}"
            )
        if not (0 < width < 2**20 and 0 < height < 2**20):
            raise FormatError(f"{path}: camera {camera_id}: size: expected 1 to 2^20, got {width}x{height}")
        distortion = {key: value for key, value in values.items() if key[0] in "kp"}
        lenses[camera_id] = Lens(width, height, fx, fy, values["cx"], values["cy"], distortion)
    file.end()
    return lenses


def read_images(path: Path) -> list[RegisteredImage]:
    """The pictures of `images.bin`. Raises FormatError."""
    file = _Reader(path)
    images = []
    for _ in range(file.count(73)):
        _, *pose, camera_id = file.take("<i7di")
        name = file.text()
        file.skip(24 * file.count(24))
        images.append(RegisteredImage(name, camera_id, _c2w(np.array(pose), f"{path}: {name}")))
    file.end()
    return images


def read_points(path: Path) -> np.ndarray:
    """The points [n_points, 3] of `points3D.bin`, world frame. Raises FormatError."""
    file = _Reader(path)
    points = []
    for _ in range(file.count(51)):
        points.append(file.take("<Q3d")[1:])
        file.skip(11)
        file.skip(8 * file.count(8))
    file.end()
    found = np.array(points).reshape(-1, 3)
    return found[np.isfinite(found).all(axis=1)]


def _c2w(pose: np.ndarray, where: str) -> np.ndarray:
    """Camera to world [4, 4], OpenGL axes, from COLMAP's world to camera (w, x, y, z of a quaternion,
    translation)."""
    length = np.linalg.norm(pose[:4])
    if not np.isfinite(pose).all() or length < 1e-9:
        raise FormatError(f"{where}: pose: expected a rotation and a translation, got {pose.tolist()}")
    w, x, y, z = pose[:4] / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T
    c2w[:3, 3] = -rotation.T @ pose[4:]
    return c2w @ OPENGL_FROM_OPENCV


def _picture_path(folder: Path, name: str) -> Path:
    inside = Path(name)
    if inside.is_absolute() or ".." in inside.parts:
        raise FormatError(f"{folder}: {name}: expected a picture inside the folder")
    for candidate in (folder / "images" / inside, folder / inside):
        if candidate.is_file():
            return candidate
    raise DataError(f"{folder}: {name}: picture is missing: expected {folder / 'images' / name}")


class _Reader:
    """A little-endian binary file, with every read checked against what is left."""

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise FormatError(f"{path}: no such file: expected a COLMAP model in binary form")
        self._data = path.read_bytes()
        self._at = 0

    def take(self, form: str) -> tuple:
        start = self._at
        self.skip(struct.calcsize(form))
        return struct.unpack_from(form, self._data, start)

    def skip(self, n_bytes: int) -> None:
        if n_bytes > len(self._data) - self._at:
            raise FormatError(f"{self._path}: cut short at byte {len(self._data)}")
        self._at += n_bytes

    def count(self, least_bytes: int) -> int:
        """A number of things of at least so many bytes each, which must still fit."""
        (n,) = self.take("<Q")
        if n * least_bytes > len(self._data) - self._at:
            raise FormatError(f"{self._path}: cut short: {n} entries do not fit into {len(self._data)} bytes")
        return n

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise FormatError(f"{self._path}: cut short in a name")
        raw, self._at = self._data[self._at : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError:
            raise FormatError(f"{self._path}: name: expected UTF-8, got {raw[:40]!r}") from None

    def end(self) -> None:
        if self._at != len(self._data):
            raise FormatError(
                f"{self._path}: expected the end at byte {self._at}, got {len(self._data)} bytes"
            )
