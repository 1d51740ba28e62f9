"""Binary little-endian PLY: the format of the mesh inside an asset, which every mesh program reads.

A vertex has x y z nx ny nz as float, and red green blue alpha as uchar (sRGB; by these names Blender and
MeshLab find the colour). A face is a list of three int. The mesh inside an asset has no normals and no alpha,
which saves 13 of 28 bytes per vertex; readers compute the normals from the faces. `parse_ply` reads only
these two layouts, and accounts for every byte.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from exporters.shapes.mesh import TriangleMesh, unit_normals
from player.errors import FormatError, IntegrityError, VfrError

VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 4)])
FACE = np.dtype([("n", "u1"), ("corners", "<i4", 3)])

SMALL_VERTEX = np.dtype([("position", "<f4", 3), ("colour", "u1", 3)])

HEADER = """\
ply
format binary_little_endian 1.0
element vertex {n_vertices}
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
property uchar alpha
element face {n_faces}
property list uchar int vertex_indices
end_header
"""
SMALL_HEADER = "".join(
    line for line in HEADER.splitlines(True) if line.split()[-1] not in ("nx", "ny", "nz", "alpha")
)
_NUMBER = "(0|[1-9][0-9]{0,9})"
_PATTERNS = [
    (vertex, re.compile(header.format(n_vertices=_NUMBER, n_faces=_NUMBER).encode()))
    for vertex, header in ((VERTEX, HEADER), (SMALL_VERTEX, SMALL_HEADER))
]


def ply_bytes(mesh: TriangleMesh) -> bytes:
    """Return the file's content; the same mesh gives the same bytes.

    >>> empty = np.zeros((0, 3))
    >>> mesh = TriangleMesh(empty, empty.astype(np.int32), empty, np.zeros((0, 4), np.uint8))
    >>> ply_bytes(mesh).startswith(b"ply")
    True
    """
    return _file(HEADER, vertex_rows(mesh), mesh.faces)


def small_ply_bytes(mesh: TriangleMesh) -> bytes:
    """Return the content of an asset's `mesh.ply`, which has no normals and no alpha.

    >>> corners = np.zeros((4, 3))
    >>> up = np.tile([0.0, 0, 1], (4, 1))
    >>> mesh = TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), up, np.full((4, 4), 255, np.uint8))
    >>> len(small_ply_bytes(mesh)) == small_ply_size(4, 1), len(ply_bytes(mesh)) > small_ply_size(4, 1)
    (True, True)
    """
    rows = np.empty(len(mesh.vertices), SMALL_VERTEX)
    rows["position"], rows["colour"] = mesh.vertices, mesh.colours[:, :3]
    return _file(SMALL_HEADER, rows, mesh.faces)


def small_ply_size(n_vertices: int, n_faces: int) -> int:
    """Return how many bytes `small_ply_bytes` returns."""
    header = len(SMALL_HEADER.format(n_vertices=n_vertices, n_faces=n_faces))
    return header + n_vertices * SMALL_VERTEX.itemsize + n_faces * FACE.itemsize


def _file(header: str, rows: np.ndarray, corners: np.ndarray) -> bytes:
    faces = np.empty(len(corners), FACE)
    faces["n"], faces["corners"] = 3, corners
    return header.format(n_vertices=len(rows), n_faces=len(faces)).encode() + rows.tobytes() + faces.tobytes()


def vertex_rows(mesh: TriangleMesh) -> np.ndarray:
    """Return the vertices of a mesh as a file stores them, [n_vertices] of VERTEX."""
    rows = np.empty(len(mesh.vertices), VERTEX)
    rows["position"], rows["normal"], rows["colour"] = mesh.vertices, mesh.normals, mesh.colours
    return rows


def parse_ply(data: bytes, where: str) -> TriangleMesh:
    """Return the mesh in the content of a file that `ply_bytes` or `small_ply_bytes` made. If there are no
    normals in it, they are computed from the faces, weighted by area.

    `where` names the file in an error message.

    Raises:
        FormatError: the header is another one, or the content is not a mesh.
        IntegrityError: the content is shorter or longer than its header says.
    """
    matches = ((vertex, pattern.match(data)) for vertex, pattern in _PATTERNS)
    vertex, match = next((found for found in matches if found[1]), (VERTEX, None))
    if match is None:
        raise FormatError(
            f"{where}: header: expected a binary PLY as `vfr-bake` writes it, got {bytes(data[:40])!r}"
        )
    n_vertices, n_faces = int(match[1]), int(match[2])
    body = match.end()
    expected = body + n_vertices * vertex.itemsize + n_faces * FACE.itemsize
    if len(data) != expected:
        raise IntegrityError(f"{where}: size: expected {expected} bytes, got {len(data)}")
    vertices = np.frombuffer(data, vertex, n_vertices, body)
    faces = np.frombuffer(data, FACE, n_faces, body + n_vertices * vertex.itemsize)
    if (faces["n"] != 3).any():
        raise FormatError(
            f"{where}: faces: expected triangles, got a face of {faces['n'][faces['n'] != 3][0]} corners"
        )
    positions = np.ascontiguousarray(vertices["position"], np.float32)
    corners = np.ascontiguousarray(faces["corners"], np.int32)
    try:
        if vertex is VERTEX:
            normals = np.ascontiguousarray(vertices["normal"], np.float32)
            return TriangleMesh(positions, corners, normals, np.ascontiguousarray(vertices["colour"]))
        colours = np.pad(vertices["colour"], ((0, 0), (0, 1)), constant_values=255)
        up = np.tile(np.array([0, 0, 1], np.float32), (len(positions), 1))
        flat = TriangleMesh(positions, corners, up, colours)  # checks the arrays that normals are made from
        return replace(flat, normals=unit_normals(np.zeros(positions.shape), positions, corners))
    except VfrError as error:
        raise FormatError(f"{where}: {error}") from error
