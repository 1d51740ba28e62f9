"""PLY, binary little endian: the mesh inside an asset, and the format that every mesh program reads.

Vertex: x y z nx ny nz float, red green blue alpha uchar (sRGB; the names are what makes Blender and MeshLab
show the colour). Face: a list of three int. `read_ply` reads this layout alone, and accounts for every byte.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from exporters.shapes.mesh import TriangleMesh
from player.errors import FormatError, IntegrityError, VfrError
from player.files.files import read_bytes

MAX_BYTES = 4 << 30
"""A hundred million faces. What an asset's mesh may take is compared with its budget when it is opened."""
VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 4)])
FACE = np.dtype([("n", "u1"), ("corners", "<i4", 3)])

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
_PATTERN = re.compile(HEADER.format(n_vertices="(0|[1-9][0-9]{0,9})", n_faces="(0|[1-9][0-9]{0,9})").encode())


def ply_bytes(mesh: TriangleMesh) -> bytes:
    """The file's content; the same mesh gives the same bytes.

    >>> empty = np.zeros((0, 3))
    >>> mesh = TriangleMesh(empty, empty.astype(np.int32), empty, np.zeros((0, 4), np.uint8))
    >>> ply_bytes(mesh).startswith(b"ply")
    True
    """
    vertices = vertex_rows(mesh)
    faces = np.empty(len(mesh.faces), FACE)
    faces["n"], faces["corners"] = 3, mesh.faces
    header = HEADER.format(n_vertices=len(vertices), n_faces=len(faces)).encode()
    return header + vertices.tobytes() + faces.tobytes()


def vertex_rows(mesh: TriangleMesh) -> np.ndarray:
    """The vertices of a mesh as they are in a file, [n_vertices] of VERTEX."""
    rows = np.empty(len(mesh.vertices), VERTEX)
    rows["position"], rows["normal"], rows["colour"] = mesh.vertices, mesh.normals, mesh.colours
    return rows


def read_ply(path: Path) -> TriangleMesh:
    """The mesh in a file that `ply_bytes` wrote.

    Raises:
        FormatError: the file cannot be read, its header is another one, or its content is not a mesh.
        IntegrityError: the file is shorter or longer than its header says.
    """
    return parse_ply(read_bytes(path, "a mesh", MAX_BYTES), str(path))


def parse_ply(data: bytes, where: str) -> TriangleMesh:
    """The mesh in `data`; `where` names it in an error message."""
    match = _PATTERN.match(data)
    if match is None:
        raise FormatError(
            f"{where}: header: expected a binary PLY as `vfr-bake` writes it, got {bytes(data[:40])!r}"
        )
    n_vertices, n_faces = int(match[1]), int(match[2])
    body = match.end()
    expected = body + n_vertices * VERTEX.itemsize + n_faces * FACE.itemsize
    if len(data) != expected:
        raise IntegrityError(f"{where}: size: expected {expected} bytes, got {len(data)}")
    vertices = np.frombuffer(data, VERTEX, n_vertices, body)
    faces = np.frombuffer(data, FACE, n_faces, body + n_vertices * VERTEX.itemsize)
    if (faces["n"] != 3).any():
        raise FormatError(
            f"{where}: faces: expected triangles, got a face of {faces['n'][faces['n'] != 3][0]} corners"
        )
    try:
        return TriangleMesh(
            np.ascontiguousarray(vertices["position"], np.float32),
            np.ascontiguousarray(faces["corners"], np.int32),
            np.ascontiguousarray(vertices["normal"], np.float32),
            np.ascontiguousarray(vertices["colour"]),
        )
    except VfrError as error:
        raise FormatError(f"{where}: {error}") from error
