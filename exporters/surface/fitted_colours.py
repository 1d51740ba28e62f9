"""Vertex colours fitted by least squares to what the training cameras see.

Letters: a pixel whose ray hits a face shows sum b_k c_k, with b the weights of the face's corners at the hit
and c their colours; the rendered picture has y there. A has a row of weights for each such pixel. The colours
minimise |A c - y|^2 + SMOOTH * sum over edges |c_i - c_j|^2; the second term decides only where hardly a
pixel lands. The minimum is found by conjugate gradients, preconditioned by the diagonal.

A pixel does not count where the picture is less than half opaque or shows something that is not as far away
as the mesh: there, the mesh lacks something thin or has something that should not be there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from exporters.extras import needs
from exporters.mesh.rays import MeshRays
from exporters.shapes.colour import KnownColours
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.depth_views import DepthView
from player.progress import Progress, silent

SMOOTH = 0.03
"""Weight of an edge; a pixel has weight 1."""
_ROUNDS = 40  # steps of the conjugate gradients; colours in 8 bits settle in about twenty


def fit_colours(
    mesh: TriangleMesh, views: list[DepthView], tolerance: float, progress: Progress = silent
) -> KnownColours:
    """Fit the colours of a mesh's vertices to views.

    Args:
        mesh: world frame; its own colours are not used.
        views: cameras, and what they see.
        tolerance: largest difference between the depth of a pixel and that of the mesh there, world units.
        progress: called with (done, of) after each view.

    Returns:
        rgb [n_vertices, 3] float64; a vertex is known if a pixel counts for it, or for a vertex that faces
        connect it with.

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
    """Return the sparse matrix L [n, n] for which c^T L c is the sum over edges |c_i - c_j|^2."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import laplacian

    start, end = faces[:, [0, 1, 2]].T.reshape(-1), faces[:, [1, 2, 0]].T.reshape(-1)
    half = csr_matrix((np.ones(len(start)), (start, end)), (n, n))
    edges = half + half.T
    edges.data[:] = 1  # an edge that two faces share counts once
    return laplacian(edges).tocsr()


def _solved(square: Any, right: np.ndarray, count: np.ndarray) -> KnownColours:
    """Solve `square` [n, n] @ rgb = `right` [n, 3] for the rgb. `count` [n] is the sum of the weights of the
    pixels that count for each vertex; a vertex is known if its count, or that of a vertex connected with it
    by edges, is not 0."""
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
