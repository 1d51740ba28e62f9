"""Crop of a mesh to an oriented box, in world units.

On the command line a box is `X,Y,Z,W,D,H` or `X,Y,Z,W,D,H,YAW`: its centre, its whole edge lengths, and a
turn in degrees about the world's Z, counter-clockwise seen from above. A JSON file describes any other
orientation: `{"matrix": 4 x 4, "size": [W, D, H]}`, where the matrix is rigid and maps the box's frame, whose
origin is the box's centre, to the world; or the same numbers by name, `{"centre": [X, Y, Z], "size": [W, D,
H], "yaw": 30}`.

A face is kept if its three corners are in the box or on its sides. No face is cut, so the edge is as rough as
a face is long, and nothing sticks out of the box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from exporters.shapes.mesh import TriangleMesh, take_faces
from player.cameras.camera import check_pose
from player.errors import ConfigError, FormatError
from player.files.json_files import brief, parse_json, read_json

_FORM = "X,Y,Z,W,D,H[,YAW] (centre, size, degrees about Z) or a .json file"


@dataclass(frozen=True, eq=False)
class CropBox:
    """A box with any place and orientation in the world.

    >>> box = CropBox(np.eye(4), np.array([2.0, 2, 2]))
    >>> box.holds(np.array([[0.0, 0, 0], [1, 1, 1], [0, 0, 1.1]])).tolist()
    [True, True, False]
    """

    matrix: np.ndarray
    """[4, 4] rigid transform, world from box; the origin of the box's frame is the box's centre."""
    size: np.ndarray
    """[3] whole edge lengths, world units, > 0."""

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return which of the world points [n, 3] are in the box or on its sides, [n] bool. A tolerance of
        1e-6 of the box's size keeps float32 rounding of a corner from deciding."""
        local = (points - self.matrix[:3, 3]) @ self.matrix[:3, :3]
        return np.all(np.abs(local) <= self.size * (0.5 + 1e-6), axis=-1)


def parse_crop(text: str) -> CropBox:
    """Return the box that an argument or a JSON file describes; the forms are listed
    at the top of the module.

    Raises ConfigError or FormatError with one line: the argument or the file describes no box.

    >>> parse_crop("0,0,1,2,4,6,90").matrix.round(3).tolist()[0]
    [0.0, -1.0, 0.0, 0.0]
    """
    if text.lower().endswith(".json"):
        return _read_box(Path(text))
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (6, 7) or not np.isfinite(numbers).all():
        raise ConfigError(f"--crop: expected {_FORM}, got {text}")
    return _box("--crop", _turned(numbers[:3], numbers[6] if len(numbers) == 7 else 0.0), numbers[3:6])


def crop_mesh(mesh: TriangleMesh, box: CropBox) -> tuple[TriangleMesh, float]:
    """Return the faces of a mesh (world frame) inside the box, and the share of the faces removed, 0..1.

    Raises ConfigError: no face is inside; the message has the mesh's bounds.
    """
    inside = box.holds(mesh.vertices.astype(np.float64))
    keep = np.all(inside[mesh.faces], axis=-1)
    if not keep.any():
        raise nothing_inside("mesh", f"{len(mesh.faces)} faces; the mesh is", mesh.bounds)
    return (mesh if keep.all() else take_faces(mesh, keep)), 1 - float(keep.mean())


def nothing_inside(what: str, parts: str, bounds: np.ndarray) -> ConfigError:
    """Return the error for a crop that leaves nothing.

    Args:
        what: what was cropped: "mesh".
        parts: its parts, and the words that come before its bounds: "12 faces; the mesh is".
        bounds: [2, 3] its smallest and largest coordinates.
    """
    return ConfigError(
        f"--crop: expected a box with some of the {what} in it, got none of its {parts} "
        f"from {corners_text(bounds)}"
    )


def corners_text(bounds: np.ndarray | list[list[float]]) -> str:
    """Return the two corners of bounds [2, 3], to four digits of their longest side, or to whole numbers: the
    corners of a small box far from the origin then still differ.

    >>> corners_text([[4500000.1251, 500000, 299.99996], [4500001.5, 500002, 300.5]])
    '(4500000.125, 500000, 300) to (4500001.5, 500002, 300.5)'
    """
    low, high = np.asarray(bounds, np.float64)
    decimals = max(3 - math.floor(math.log10(max(1e-12, float((high - low).max())))), 0)
    corners = [[round(value, decimals) + 0.0 for value in corner.tolist()] for corner in (low, high)]
    return " to ".join("(" + ", ".join(f"{value:.15g}" for value in corner) + ")" for corner in corners)


def _read_box(path: Path) -> CropBox:
    document = parse_json(read_json(path, "a box to crop to"), str(path))
    keys = set(document) if isinstance(document, dict) else set()
    if keys == {"matrix", "size"}:
        matrix = _array(path, document, "matrix", (4, 4))
    elif keys in ({"centre", "size"}, {"centre", "size", "yaw"}):
        matrix = _turned(
            _array(path, document, "centre", (3,)).tolist(),
            float(_array(path, {"yaw": 0.0, **document}, "yaw", ())),
        )
    else:
        raise FormatError(
            f"{path}: expected matrix and size, or centre, size and yaw, got {brief(sorted(keys))}"
        )
    return _box(str(path), matrix, _array(path, document, "size", (3,)).tolist())


def _array(path: Path, document: dict[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.array(document[key], np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.full(1, np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise FormatError(f"{path}: {key}: expected {list(shape)} finite numbers, got {document[key]!r:.60}")
    return array


def _turned(centre: list[float], yaw: float) -> np.ndarray:
    angle = math.radians(yaw)
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    matrix[:3, 3] = centre
    return matrix


def _box(where: str, matrix: np.ndarray, size: list[float]) -> CropBox:
    check_pose(matrix, where, "matrix of the box")
    if not all(edge > 0 for edge in size):
        raise ConfigError(f"{where}: size: expected three lengths > 0, got {size}")
    return CropBox(matrix, np.array(size))
