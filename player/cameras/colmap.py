"""Reader of COLMAP models: the lenses, the pictures' poses and the points of `cameras.bin`, `images.bin`,
`points3D.bin`.

The format is COLMAP's (scene/reconstruction_io.cc). pycolmap's reader is not used, because it takes truncated
files for whole ones, or never returns from them. COLMAP's cameras look along +z with y down (OpenCV); the
pixel centre is at +0.5 as here. Of the text form, `cameras.txt` and `images.txt` are read.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from player.cameras.camera import Camera
from player.cameras.rotations import OPENGL_FROM_OPENCV, rotation_matrix
from player.errors import DataError, FormatError
from player.files.files import open_file, read_bytes

MODELS = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
}
"""Numbers, names and parameters of the camera models that are a pinhole with OpenCV's lens distortion or
none."""
MAX_FILE_BYTES = 1 << 30
"""Largest size of each file of a model. Half of it holds ten thousand pictures with a thousand points each
that several pictures share."""
FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one camera, and the distortion of its lens."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: dict[str, float]


@dataclass(frozen=True)
class RegisteredImage:
    """One picture whose pose COLMAP has found."""

    name: str
    camera_id: int
    c2w: np.ndarray
    """[4, 4], OpenGL axes."""


def colmap_folder(folder: Path) -> Path | None:
    """Find the folder of the COLMAP model that belongs to the pictures in `folder`; None if there is none. Of
    several models, which COLMAP numbers in any order, it is the one with the most pictures."""
    for name in FOLDERS:
        if (folder / name / "images.bin").exists():
            return max(numbered_models(folder / name), key=lambda model: _n_images(model / "images.bin"))
    return None


def numbered_models(model: Path) -> list[Path]:
    """Return the folders of a COLMAP model and of those that COLMAP has numbered beside it, in their order.

    >>> [model.name for model in numbered_models(Path("surely/not/there/0"))]
    ['0']
    """
    if not model.name.isdecimal():
        return [model]
    found = [path.parent for path in model.parent.glob("*/images.bin") if path.parent.name.isdecimal()]
    return sorted({model, *found}, key=lambda each: int(each.name))


def _n_images(path: Path) -> int:
    """Return the number of pictures that `images.bin` begins with; 0 if it is cut short. Raises
    FormatError."""
    with open_file(path, "a COLMAP model", MAX_FILE_BYTES) as file:
        return int.from_bytes(file.read(8), "little")


def read_views(model: Path, say: Callable[[str], object] = lambda text: None) -> list[Camera]:
    """Read the registered pictures of a COLMAP model as pinhole cameras, in the order of their names.

    `model`: the folder of `cameras.bin` and `images.bin`, or of `cameras.txt` and `images.txt`. Lens
    distortion is ignored, as is right for pictures that were undistorted; `say` is then called with a line.
    Raises FormatError, DataError (a camera model that is no pinhole).
    """
    suffix = "bin" if (model / "images.bin").exists() else "txt"
    if suffix == "bin":
        lenses, images = read_cameras(model / "cameras.bin"), read_images(model / "images.bin")
    else:
        lenses, images = _text_cameras(model / "cameras.txt"), _text_images(model / "images.txt")
    if not images:
        raise FormatError(f"{model}: images.{suffix}: expected at least one picture, got none")
    views, n_distorted = [], 0
    for image in sorted(images, key=lambda image: image.name):
        if image.camera_id not in lenses:
            raise FormatError(f"{model}: {image.name}: camera {image.camera_id} is not in cameras.{suffix}")
        lens = lenses[image.camera_id]
        views.append(camera_of(image, lens))
        n_distorted += any(lens.distortion.values())
    if n_distorted:
        say(f"{model}: lens distortion of {n_distorted} of {len(views)} cameras is ignored")
    return views


def camera_of(image: RegisteredImage, lens: Lens) -> Camera:
    """Return the pinhole camera of a picture, without the distortion of its lens."""
    return Camera(image.name, image.c2w, lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)


def read_cameras(path: Path) -> dict[int, Lens]:
    """Read the lenses in `cameras.bin`, by camera number. Raises FormatError, DataError (an unknown
    model)."""
    return parse_cameras(_content(path), str(path))


def parse_cameras(data: bytes, where: str) -> dict[int, Lens]:
    """Do the same as `read_cameras` for the file's content; `where` names the file in messages."""
    file = _Reader(data, where)
    lenses = {}
    for _ in range(file.count(24)):
        camera_id, model, width, height = file.take("<iiQQ")
        if model not in MODELS:
            raise _unknown_model(f"{where}: camera {camera_id}", f"number {model}")
        values = file.take(f"<{len(MODELS[model][1])}d")
        lenses[camera_id] = _lens(model, width, height, values, f"{where}: camera {camera_id}")
    file.end()
    return lenses


def _unknown_model(where: str, got: str) -> DataError:
    known = ", ".join(name for name, _ in MODELS.values())
    return DataError(
        f"{where}: model: expected {known}, got {got}: "
        "undistort the pictures with COLMAP's image_undistorter first"
    )


def _lens(model: int, width: float, height: float, parameters: Sequence[float], where: str) -> Lens:
    values = dict(zip(MODELS[model][1], parameters, strict=True))
    fx, fy = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
    if not (np.isfinite(list(values.values())).all() and fx > 0 and fy > 0):
        raise FormatError(f"{where}: expected finite numbers and a positive focal length, got {values}")
    if not (0 < width < 2**20 and 0 < height < 2**20):
        raise FormatError(f"{where}: size: expected 1 to 2^20, got {width:.0f}x{height:.0f}")
    distortion = {key: value for key, value in values.items() if key[0] in "kp"}
    return Lens(int(width), int(height), fx, fy, values["cx"], values["cy"], distortion)


def read_images(path: Path) -> list[RegisteredImage]:
    """Read the pictures in `images.bin`, in the file's order. Raises FormatError."""
    return parse_images(_content(path), str(path))


def parse_images(data: bytes, where: str) -> list[RegisteredImage]:
    """Do the same as `read_images` for the file's content; `where` names the file in messages."""
    file = _Reader(data, where)
    images = []
    for _ in range(file.count(73)):
        _, *pose, camera_id = file.take("<i7di")
        name = file.text()
        file.skip(24 * file.count(24))
        images.append(RegisteredImage(name, camera_id, _c2w(np.array(pose), f"{where}: {name}")))
    file.end()
    return images


def read_points(path: Path) -> np.ndarray:
    """Read the points [n_points, 3] of `points3D.bin`, world frame. Raises FormatError."""
    file = _Reader(_content(path), str(path))
    points = []
    for _ in range(file.count(51)):
        points.append(file.take("<Q3d")[1:])
        file.skip(11)
        file.skip(8 * file.count(8))
    file.end()
    found = np.array(points).reshape(-1, 3)
    return found[np.isfinite(found).all(axis=1)]


def _c2w(pose: np.ndarray, where: str) -> np.ndarray:
    """Return camera to world [4, 4], OpenGL axes, from COLMAP's world to camera (w, x, y, z of a quaternion,
    then a translation)."""
    length = np.linalg.norm(pose[:4])
    if not np.isfinite(pose).all() or length < 1e-9:
        raise FormatError(f"{where}: pose: expected a rotation and a translation, got {pose.tolist()}")
    rotation = rotation_matrix(pose[:4] / length)
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T
    c2w[:3, 3] = -rotation.T @ pose[4:]
    return c2w @ OPENGL_FROM_OPENCV


def _text_cameras(path: Path) -> dict[int, Lens]:
    numbers = {name: number for number, (name, _) in MODELS.items()}
    lenses = {}
    for number, line in _lines(path):
        words = line.split()
        where = f"{path}: line {number}"
        if len(words) > 1 and words[1] not in numbers:
            raise _unknown_model(f"{path}: camera {words[0]}", words[1])
        model = numbers[words[1]] if len(words) > 1 else 0
        if len(words) != 4 + len(MODELS[model][1]):
            raise FormatError(f"{where}: expected number, model, size and parameters, got {line[:80]!r}")
        width, height, *values = _floats(words[2:], where)
        lenses[int(*_floats(words[:1], where))] = _lens(model, width, height, values, where)
    return lenses


def _text_images(path: Path) -> list[RegisteredImage]:
    """Read the pictures in `images.txt`. Each has two lines, of which the second holds its points and may be
    empty."""
    images, skip = [], 0
    for number, line in _lines(path, empty=True):
        if number == skip or not line:
            continue
        words = line.split(maxsplit=9)
        where = f"{path}: line {number}"
        if len(words) != 10:
            raise FormatError(f"{where}: expected number, pose, camera and name, got {line[:80]!r}")
        pose = np.array(_floats(words[1:8], where))
        camera_id = int(*_floats(words[8:9], where))
        images.append(RegisteredImage(words[9], camera_id, _c2w(pose, f"{path}: {words[9]}")))
        skip = number + 1
    return images


def _lines(path: Path, empty: bool = False) -> list[tuple[int, str]]:
    """Return the numbers and texts of lines that are not comments; with `empty`, also of empty lines."""
    try:
        text = read_bytes(path, "a COLMAP model", MAX_FILE_BYTES).decode()
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: cannot read: {error}") from error
    lines = ((number, line.strip()) for number, line in enumerate(text.split("\n"), start=1))
    return [(number, line) for number, line in lines if not line.startswith("#") and (line or empty)]


def _floats(words: list[str], where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [float("nan")]
    if not np.isfinite(values).all():
        raise FormatError(f"{where}: expected finite numbers, got {' '.join(words)[:80]!r}")
    return values


def _content(path: Path) -> bytes:
    return read_bytes(path, "a COLMAP model in binary form", MAX_FILE_BYTES)


class _Reader:
    """Reader of a little-endian binary file, which checks every read against the bytes that are left."""

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._where, self._at = data, where, 0

    def take(self, form: str) -> tuple:
        start = self._at
        self.skip(struct.calcsize(form))
        return struct.unpack_from(form, self._data, start)

    def skip(self, n_bytes: int) -> None:
        if n_bytes > len(self._data) - self._at:
            raise FormatError(f"{self._where}: cut short at byte {len(self._data)}")
        self._at += n_bytes

    def count(self, least_bytes: int) -> int:
        """Read a count of entries, and check that so many of at least `least_bytes` each still fit."""
        (n,) = self.take("<Q")
        if n * least_bytes > len(self._data) - self._at:
            raise FormatError(
                f"{self._where}: cut short: {n} entries do not fit into {len(self._data)} bytes"
            )
        return n

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise FormatError(f"{self._where}: cut short in a name")
        raw, self._at = self._data[self._at : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError:
            raise FormatError(f"{self._where}: name: expected UTF-8, got {raw[:40]!r}") from None

    def end(self) -> None:
        if self._at != len(self._data):
            raise FormatError(
                f"{self._where}: expected the end at byte {self._at}, got {len(self._data)} bytes"
            )
