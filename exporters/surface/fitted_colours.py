"""Vertex colours that come nearest to what the training cameras see: least squares.

Letters: a pixel whose ray meets a face shows sum b_k c_k, b its shares of the face's corners and c their
colours; the picture that was played has y there. A has a row of shares for each such pixel. The colours are
those of the smallest |A c - y|^2 + SMOOTH * sum over edges |c_i - c_j|^2; the second part decides only where
hardly a pixel lands. It is quadratic: conjugate gradients, scaled by the diagonal, find it.

A pixel does not count where the picture is less than half opaque or shows something that is not as far away
as the mesh: there, the mesh misses something thin or has something too much.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from exporters.extras import needs
from exporters.mesh.rays import MeshRays
from exporters.progress import Progress, silent
from exporters.shapes.colour import KnownColours
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.depth_views import DepthView

SMOOTH = 0.03
"""The weight of an edge beside that of a pixel, which is 1."""
_ROUNDS = 40  # steps of the conjugate gradients; colours in 8 bits settle in about twenty


def fit_colours(
    mesh: TriangleMesh, views: list[DepthView], tolerance: float, progress: Progress = silent
) -> KnownColours:
    """Colours of a mesh's vertices, fitted to views.

    Args:
        mesh: world frame; its own colours are not looked at.
        views: cameras, and what they see.
        tolerance: how far from the depth of a pixel the mesh may be there, world units.
        progress: called with (done, of) after each view.

    Returns:
        rgb [n_vertices, 3] float64; a vertex is known if a pixel counts for it, or for one that faces connect
        it with.

    Raises MissingExtraError: Open3D or scipy is not installed.
    """
    rays = MeshRays(mesh)
    with needs("the mesh", "scipy"):
        from scipy.sparse import csr_matrix
    n = len(mesh.vertices)
    square, right, count = _smoothness(mesh.faces, n) * SMOOTH, np.zeros((n, 3)), np.zeros(n)
    for done, view in enumerate(views, start=1):
        hits = rays.seen_by(view.camera)
        expected = view.distance.reshape(-1)[hits.pixels]
        counted = np.isfinite(expected)
        counted[counted] = np.abs(hits.distance - expected)[counted] <= tolerance
        shares, corners = hits.shares[counted], mesh.faces[hits.faces[counted]]
        ends = np.arange(0, shares.size + 1, 3)
        rows = csr_matrix((shares.reshape(-1), corners.reshape(-1), ends), (len(shares), n))
        square = square + rows.T @ rows
        right += rows.T @ (view.rgb.reshape(-1, 3)[hits.pixels[counted]] / 255.0)
        count += rows.T @ np.ones(len(shares))
        progress(done, len(views))
    return _solved(square, right, count)


def _smoothness(faces: np.ndarray, n: int) -> Any:
    """The sparse matrix L [n, n] for which c^T L c is the sum over edges |c_i - c_j|^2."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import laplacian

    start, end = faces[:, [0, 1, 2]].T.reshape(-1), faces[:, [1, 2, 0]].T.reshape(-1)
    half = csr_matrix((np.ones(len(start)), (start, end)), (n, n))
    edges = half + half.T
    edges.data[:] = 1  # an edge of two faces is one edge
    return laplacian(edges).tocsr()


def _solved(square: Any, right: np.ndarray, count: np.ndarray) -> KnownColours:
    """The rgb for which `square` [n, n] @ rgb is `right` [n, 3]; known is what a pixel decides, there being
    `count` [n] of them at each vertex, or edges that lead to such a vertex."""
    from scipy.sparse.csgraph import connected_components

    part = connected_components(square, directed=False)[1]
    known = (np.bincount(part, weights=count) > 0)[part]
    seen = count > 0
    colours = np.where(seen[:, None], right / np.where(seen, count, 1)[:, None], 0.5)
    scale = square.diagonal()
    inverse = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1), 0)[:, None]
    left = right - square @ colours
    towards = inverse * left
    direction, reached = towards, (left * towards).sum(axis=0)
    for _ in range(_ROUNDS):
        moved = square @ direction
        length = reached / np.maximum((direction * moved).sum(axis=0), 1e-30)
        colours = colours + length * direction
        left = left - length * moved
        towards = inverse * left
        now = (left * towards).sum(axis=0)
        direction = towards + now / np.maximum(reached, 1e-30) * direction
        reached = now
    return KnownColours(np.clip(colours, 0, 1), known)
