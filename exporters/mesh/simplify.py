"""Mesh simplification: quadric edge collapse (Garland and Heckbert 1997) by Open3D, which
keeps colours and normals.

Open3D averages the colours and normals of the two ends of each edge that it collapses. It does not know
alpha, which is taken from the nearest vertex of the source. It stops early where collapsing any edge that is
left would fold the surface, as in a mesh of many thin parts (lego, 380,541 faces: a target of 20,000 is
reached, one of 5,000 leaves 11,721). Vertices in the same small cube are then merged, and edges are collapsed
again, with larger and larger cubes, until there are as few faces as were asked for.

Edge collapse takes minutes for millions of faces. A mesh that large is merged in cubes first, until about
FIRST times the faces that are asked for are left.
"""

from __future__ import annotations

import numpy as np

from exporters.extras import needs, require_open3d
from exporters.shapes.mesh import TriangleMesh, has_three_corners, unit_normals
from player.files.images import to_8_bit

FIRST = 12
"""Edges are collapsed from about this many times the faces that are asked for; a mesh of more than twice as
many is merged in cubes first."""
LEAST_FIRST = 12_000
"""Edges are collapsed from at least about this many faces: in the cubes that leave fewer, small parts vanish.
"""
LEAST = 4
"""Faces of the smallest closed surface. Where fewer are asked for, Open3D may leave nothing."""


def simplify_mesh(mesh: TriangleMesh, n_faces: int) -> TriangleMesh:
    """Return the mesh with at most `n_faces` faces, or with the fewest that were reached before nothing was
    left; a mesh that has no more is returned itself. The same mesh gives the same result.

    Args:
        mesh: any mesh; parts that are not connected are simplified together.
        n_faces: 1 or more; a closed surface needs 4.

    Raises MissingExtraError: Open3D is not installed.

    >>> empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)),
    ...     np.zeros((0, 4), np.uint8))
    >>> simplify_mesh(empty, 100) is empty
    True
    """
    cube, first = 0.0, max(FIRST * n_faces, LEAST_FIRST)
    if len(mesh.faces) > 2 * first:
        cube = mean_edge(mesh.vertices, mesh.faces) * (len(mesh.faces) / first) ** 0.5
    while len(mesh.faces) > n_faces:
        few = _collapsed(mesh, max(n_faces, LEAST), cube)
        if not len(few.faces):
            break
        # a quarter of an edge, because cubes of a whole edge can merge three in four of the faces at once
        mesh, cube = few, max(1.2 * cube, mean_edge(few.vertices, few.faces) / 4)
    return mesh


def _collapsed(mesh: TriangleMesh, n_faces: int, cube: float) -> TriangleMesh:
    """Return the mesh after vertices in the same cube of edge `cube` were merged, unless that is 0, and edges
    were collapsed until `n_faces` faces are left or no other can be."""
    open3d = require_open3d("--faces")
    # Quadrics have products of coordinates, which lose their digits far from the origin.
    middle = mesh.bounds.astype(np.float64).mean(axis=0)
    source = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices - middle),
        open3d.utility.Vector3iVector(np.ascontiguousarray(mesh.faces)),
    )
    source.vertex_normals = open3d.utility.Vector3dVector(np.ascontiguousarray(mesh.normals, np.float64))
    source.vertex_colors = open3d.utility.Vector3dVector(mesh.colours[:, :3] / 255)
    if cube:
        average = open3d.geometry.SimplificationContraction.Average
        source = source.simplify_vertex_clustering(cube, average)
    result = source.simplify_quadric_decimation(n_faces)
    faces = np.asarray(result.triangles, np.int32).reshape(-1, 3)
    used, numbers = np.unique(faces[has_three_corners(faces)], return_inverse=True)
    vertices = np.asarray(result.vertices)[used] + middle
    faces = numbers.reshape(-1, 3).astype(np.int32)
    colours = np.empty((len(used), 4), np.uint8)
    colours[:, :3] = to_8_bit(np.asarray(result.vertex_colors)[used])
    colours[:, 3] = _alpha(mesh, vertices)
    normals = unit_normals(np.asarray(result.vertex_normals)[used], vertices, faces, 1e-6)
    return TriangleMesh(vertices, faces, normals, colours)


def clustered(vertices: np.ndarray, faces: np.ndarray, cube: float) -> tuple[np.ndarray, np.ndarray]:
    """Merge all vertices of a mesh that lie in the same cube, at their mean.

    Args:
        vertices: [n_vertices, 3] float64.
        faces: [n_faces, 3] int32.
        cube: edge of the cubes, in the vertices' unit.

    Returns:
        Vertices [m, 3] float64, and the faces [k, 3] int32 that still have three corners.

    Raises MissingExtraError: Open3D is not installed.
    """
    open3d = require_open3d("the mesh")
    source = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(np.ascontiguousarray(vertices, np.float64)),
        open3d.utility.Vector3iVector(np.ascontiguousarray(faces, np.int32)),
    )
    average = open3d.geometry.SimplificationContraction.Average
    result = source.simplify_vertex_clustering(cube, average)
    few = np.asarray(result.triangles, np.int32).reshape(-1, 3)
    used, numbers = np.unique(few[has_three_corners(few)], return_inverse=True)
    return np.asarray(result.vertices)[used], numbers.reshape(-1, 3).astype(np.int32)


def mean_edge(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the mean length of the first edge of each face."""
    return float(np.linalg.norm(vertices[faces[:, 1]] - vertices[faces[:, 0]], axis=1).mean())


def _alpha(mesh: TriangleMesh, vertices: np.ndarray) -> np.ndarray:
    alpha = mesh.colours[:, 3]
    if (alpha == alpha[0]).all():
        return np.full(len(vertices), alpha[0])
    with needs("--faces", "scipy"):
        from scipy.spatial import KDTree
    return alpha[KDTree(mesh.vertices).query(vertices)[1]]
