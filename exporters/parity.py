"""Does a written mesh hold what it was written from? Counts and bounds, read from the bytes and compared
before any rename.
"""

from __future__ import annotations

import numpy as np

from exporters.glb import parse_glb, y_up
from exporters.mesh import TriangleMesh
from exporters.ply import parse_ply
from exporters.points import parse_points
from exporters.stl import parse_stl
from player.errors import ParityError


def check_mesh_bytes(suffix: str, data: bytes, mesh: TriangleMesh, where: str) -> None:
    """Raises ParityError if `data`, the content of a `suffix` (.ply, .obj, .glb, .stl) file, has other counts
    or bounds than `mesh`; of an STL, which has no vertices, other corners.

    Bounds may differ by what the format rounds: float32 for PLY, GLB and STL, nine digits for OBJ.
    """
    if suffix == ".stl":
        corners = parse_stl(data, where)["corners"].reshape(-1, 3)
        _check_places(where, "corners", mesh.vertices[mesh.faces].reshape(-1, 3), corners)
        return
    n_vertices, n_faces, bounds = {".ply": _ply, ".obj": _obj, ".glb": _glb}[suffix](data, where)
    for name, expected, got in (
        ("vertices", len(mesh.vertices), n_vertices),
        ("faces", len(mesh.faces), n_faces),
    ):
        if expected != got:
            raise ParityError(f"{where}: {name}: expected {expected}, got {got}")
    expected = y_up(mesh.vertices) if suffix == ".glb" else mesh.vertices
    if not len(expected):
        return
    expected = np.stack([expected.min(0), expected.max(0)])
    tolerance = 2e-7 * max(float(np.abs(expected).max()), 1e-30)
    worst = float(np.abs(expected - bounds).max())
    if not worst <= tolerance:
        raise ParityError(
            f"{where}: bounds: expected {expected.tolist()}, got {bounds.tolist()}: "
            f"{worst:g} apart, tolerance {tolerance:g}"
        )


def check_points_bytes(data: bytes, cloud: TriangleMesh, where: str) -> None:
    """Raises ParityError if `data`, the content of a point cloud's PLY, holds other points than `cloud`."""
    points = parse_points(data, where)
    _check_places(where, "points", cloud.vertices, points["position"])
    _check_places(where, "normals", cloud.normals, points["normal"])
    if not np.array_equal(points["colour"], cloud.colours):
        raise ParityError(f"{where}: colours: expected those of the points, got others")


def _check_places(where: str, what: str, expected: np.ndarray, got: np.ndarray) -> None:
    """Row by row, to the rounding of float32 at the largest coordinate."""
    if expected.shape != got.shape:
        raise ParityError(f"{where}: {what}: expected {len(expected)}, got {len(got)}")
    apart = np.abs(expected - got.astype(np.float64)).max(axis=-1, initial=0)
    tolerance = 2e-7 * max(float(np.abs(expected).max(initial=0)), 1e-30)
    if not (apart <= tolerance).all():
        row = int(np.argmax(np.where(np.isnan(apart), np.inf, apart)))
        raise ParityError(
            f"{where}: {what}: number {row}: expected {expected[row].tolist()}, got {got[row].tolist()}: "
            f"{apart[row]:g} apart, tolerance {tolerance:g}"
        )


def _ply(data: bytes, where: str) -> tuple[int, int, np.ndarray]:
    mesh = parse_ply(data, where)
    return len(mesh.vertices), len(mesh.faces), mesh.bounds.astype(np.float64)


def _obj(data: bytes, where: str) -> tuple[int, int, np.ndarray]:
    start, normals = data.find(b"\nv "), data.find(b"\nvn ")
    rows = np.fromstring(data[start:normals].replace(b"v", b"").decode(), sep=" ").reshape(-1, 6)
    return len(rows), data.count(b"\nf "), np.stack([rows[:, :3].min(0), rows[:, :3].max(0)])


def _glb(data: bytes, where: str) -> tuple[int, int, np.ndarray]:
    document, buffer = parse_glb(data, where)
    primitive = document["meshes"][0]["primitives"][0]
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    indices = document["accessors"][primitive["indices"]]
    view = document["bufferViews"][position["bufferView"]]
    values = np.frombuffer(buffer, "<f4", 3 * position["count"], view["byteOffset"]).reshape(-1, 3)
    bounds = np.stack([values.min(0), values.max(0)]).astype(np.float64)
    if bounds.tolist() != [position["min"], position["max"]]:
        raise ParityError(f"{where}: POSITION: min and max: expected {bounds.tolist()}, got {position}")
    return position["count"], indices["count"] // 3, bounds
