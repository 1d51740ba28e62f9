"""Removal of small connected parts of a mesh, which float in front of what the photographs show."""

from __future__ import annotations

import numpy as np

from exporters.extras import needs
from exporters.shapes.mesh import TriangleMesh, take_faces


def remove_small_components(mesh: TriangleMesh, min_fraction: float) -> tuple[TriangleMesh, int]:
    """Return the mesh without the connected parts that have fewer than `min_fraction` of all faces, and how
    many parts were removed.

    Args:
        mesh: the mesh, whose parts are connected through shared vertices.
        min_fraction: share of the faces, 0 (keep all) to 1; the largest part always stays.

    Raises MissingExtraError: scipy is not installed.
    """
    if not len(mesh.faces):
        return mesh, 0
    with needs("the mesh", "scipy"):
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components
    n_vertices = len(mesh.vertices)
    start, end = mesh.faces[:, [0, 1]].T.ravel(), mesh.faces[:, [1, 2]].T.ravel()
    edges = coo_matrix((np.ones(len(start), bool), (start, end)), (n_vertices, n_vertices))
    part = connected_components(edges, directed=False)[1][mesh.faces[:, 0]]
    n_faces = np.bincount(part)
    kept = n_faces >= min_fraction * len(mesh.faces)
    kept[n_faces.argmax()] = True
    n_removed = int(((n_faces > 0) & ~kept).sum())
    return (take_faces(mesh, kept[part]), n_removed) if n_removed else (mesh, 0)
