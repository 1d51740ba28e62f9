"""The part of a mesh inside an oriented box, in world units.

A person types `X,Y,Z,W,D,H` or `X,Y,Z,W,D,H,YAW`: centre, whole edge lengths, and degrees about the world's
Z, counter-clockwise seen from above. For any other orientation a JSON file: `{"matrix": 4 x 4, "size": [W, D,
H]}`, where the matrix is rigid and takes the box's frame, its centre at the origin, to the world; or the same
numbers by name, `{"centre": [X, Y, Z], "size": [W, D, H], "yaw": 30}`.

A face stays when its three corners are in the box (its faces included): nothing is cut, so the edge is as
rough as a face is long, and nothing sticks out.
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
    """A box anywhere in the world.

    >>> box = CropBox(np.eye(4), np.array([2.0, 2, 2]))
    >>> box.holds(np.array([[0.0, 0, 0], [1, 1, 1], [0, 0, 1.1]])).tolist()
    [True, True, False]
    """

    matrix: np.ndarray
    """[4, 4] rigid, world from box; the box's centre is its origin."""
    size: np.ndarray
    """[3] whole edge lengths, world units, > 0."""

    def holds(self, points: np.ndarray) -> np.ndarray:
        """[n] bool: which of the world points [n, 3] are in the box, its faces included (to 1e-6 of its size:
        what float32 does to a corner must not decide)."""
        local = (points - self.matrix[:3, 3]) @ self.matrix[:3, :3]
        return np.all(np.abs(local) <= self.size * (0.5 + 1e-6), axis=-1)


def parse_crop(text: str) -> CropBox:
    """The box that a person typed, or that a JSON file describes: the forms are at the top of the module.

    Raises ConfigError (what was typed) or FormatError (the file), in one line.

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
    """The faces of a mesh (world frame) that are inside, and the share of the faces that went, 0..1.

    Raises ConfigError: none is inside; the message has the mesh's bounds.
    """
    inside = box.holds(mesh.vertices.astype(np.float64))
    keep = np.all(inside[mesh.faces], axis=-1)
    if not keep.any():
        raise nothing_inside("mesh", f"{len(mesh.faces)} faces; the mesh is", mesh.bounds)
    return (mesh if keep.all() else take_faces(mesh, keep)), 1 - float(keep.mean())


def nothing_inside(what: str, parts: str, bounds: np.ndarray) -> ConfigError:
    """The error that a crop leaves nothing.

    Args:
        what: what was cropped: "mesh".
        parts: what it has, and the words before where it is: "12 faces; the mesh is".
        bounds: [2, 3] where it is, from and to.
    """
    low, high = ("(" + ", ".join(f"{value:.4g}" for value in corner) + ")" for corner in bounds)
    return ConfigError(
        f"--crop: expected a box with some of the {what} in it, got none of its {parts} from {low} to {high}"
    )


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
    check_pose(matrix, where)
    if not all(edge > 0 for edge in size):
        raise ConfigError(f"{where}: size: expected three lengths > 0, got {size}")
    return CropBox(matrix, np.array(size))
