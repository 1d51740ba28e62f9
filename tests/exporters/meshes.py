"""Small meshes with a known shape."""

from __future__ import annotations

import numpy as np

from exporters.mesh import TriangleMesh


def tetrahedron() -> TriangleMesh:
    """Corners at the origin and on the axes at 1, 2 and 3; outward faces; grey 128, red, green,
    half-transparent blue.
    """
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    normals = vertices - vertices.mean(0)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    colours = np.array([[128, 128, 128, 255], [255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 128]], np.uint8)
    return TriangleMesh(vertices, faces, normals, colours)


def random_mesh(n_vertices: int, n_faces: int, seed: int = 0) -> TriangleMesh:
    """Every vertex is used if `n_vertices` is a multiple of 3 and at most 3 `n_faces`."""
    random = np.random.default_rng(seed)
    vertices = random.normal(scale=4, size=(n_vertices, 3))
    normals = random.normal(size=(n_vertices, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    faces = np.argsort(random.random((n_faces, n_vertices)), axis=1)[:, :3].astype(
        np.int32
    )  # three different
    n_whole = min(n_vertices // 3, n_faces)
    faces[:n_whole] = random.permutation(n_vertices)[: 3 * n_whole].reshape(-1, 3)
    return TriangleMesh(vertices, faces, normals, random.integers(0, 256, (n_vertices, 4)).astype(np.uint8))
