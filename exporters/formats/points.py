"""Point clouds: points spread evenly over a surface, with normals and colours, as a PLY without faces.

A vertex has the layout of `exporters.formats.ply`. A cloud is a `TriangleMesh` that has no faces.
"""

from __future__ import annotations

import re

import numpy as np

from exporters.formats.ply import HEADER as MESH_HEADER
from exporters.formats.ply import VERTEX, vertex_rows
from exporters.shapes.mesh import TriangleMesh, crossed_edges, interpolated
from player.errors import DataError, FormatError

HEADER = MESH_HEADER.split("element face")[0] + "end_header\n"
_PATTERN = re.compile(HEADER.format(n_vertices="(0|[1-9][0-9]{0,9})").encode())


def sample_points(mesh: TriangleMesh, n_points: int) -> TriangleMesh:
    """Return `n_points` points on the faces of a mesh, equally dense everywhere. The result is deterministic:
    the same mesh gives the same points.

    The area is cut into `n_points` equal shares and a point is drawn in each, so that gaps and clumps are
    smaller than with independent draws. Normals and colours (sRGB) are interpolated between the corners.

    Args:
        mesh: the surface.
        n_points: 1 or more.

    Returns:
        A cloud: `vertices`, `normals`, `colours` of n_points rows, no faces.

    Raises DataError: the mesh has no area.

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> up, white = np.tile([0.0, 0.0, 1.0], (3, 1)), np.full((3, 4), 255, np.uint8)
    >>> cloud = sample_points(TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), up, white), 50)
    >>> cloud.vertices.shape, bool((cloud.vertices.sum(axis=1) <= 1).all())
    ((50, 3), True)
    """
    areas = np.linalg.norm(crossed_edges(mesh.vertices, mesh.faces), axis=-1)
    running = np.cumsum(areas)
    if not len(areas) or not running[-1] > 0:
        raise DataError("--points: expected a surface with some area, got none")
    random = np.random.default_rng(0)
    place = (np.arange(n_points) + random.random(n_points)) / n_points * running[-1]
    face = np.minimum(np.searchsorted(running, place, side="right"), len(areas) - 1)
    u, v = np.sqrt(random.random(n_points)), random.random(n_points)
    shares = np.stack([1 - u, u * (1 - v), u * v], axis=-1)
    vertices, normals = mesh.at(face, shares)
    colours = np.rint(interpolated(mesh.colours, mesh.faces[face], shares)).astype(np.uint8)
    return TriangleMesh(vertices, np.zeros((0, 3), np.int32), normals, colours)


def points_bytes(cloud: TriangleMesh) -> bytes:
    """Return the file's content; the faces of `cloud`, if it has any, are left out.

    >>> none = np.zeros((0, 3))
    >>> empty = TriangleMesh(none, np.zeros((0, 3), np.int32), none, np.zeros((0, 4), np.uint8))
    >>> points_bytes(empty).splitlines()[2]
    b'element vertex 0'
    """
    return HEADER.format(n_vertices=len(cloud.vertices)).encode() + vertex_rows(cloud).tobytes()


def parse_points(data: bytes, where: str) -> np.ndarray:
    """Return the points in `data`, [n_points] of `exporters.formats.ply.VERTEX`;
    FormatError for another file."""
    match = _PATTERN.match(data)
    if match is None or len(data) != match.end() + int(match[1]) * VERTEX.itemsize:
        raise FormatError(f"{where}: expected a point cloud as `vfr-export` writes it, got {data[:40]!r}")
    return np.frombuffer(data, VERTEX, int(match[1]), match.end())
