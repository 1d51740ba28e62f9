"""Small meshes with a known shape."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from exporters.formats.ply import parse_ply
from exporters.shapes.mesh import TriangleMesh


def read_ply(path: Path) -> TriangleMesh:
    return parse_ply(path.read_bytes(), str(path))


def tetrahedron() -> TriangleMesh:
    """Return a tetrahedron with outward faces.

    Its corners are the origin (grey 128) and 1, 2 and 3 on the axes (red, green, half-transparent blue).
    """
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    normals = vertices - vertices.mean(0)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    colours = np.array([[128, 128, 128, 255], [255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 128]], np.uint8)
    return TriangleMesh(vertices, faces, normals, colours)


def random_mesh(n_vertices: int, n_faces: int, seed: int = 0) -> TriangleMesh:
    """Return a random mesh. Every vertex is used if `n_vertices` is a multiple of 3 and <= 3 * `n_faces`."""
    random = np.random.default_rng(seed)
    vertices = random.normal(scale=4, size=(n_vertices, 3))
    normals = random.normal(size=(n_vertices, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    faces = np.argsort(random.random((n_faces, n_vertices)), axis=1)[:, :3].astype(
        np.int32
    )  # three different vertices
    n_whole = min(n_vertices // 3, n_faces)
    faces[:n_whole] = random.permutation(n_vertices)[: 3 * n_whole].reshape(-1, 3)
    return TriangleMesh(vertices, faces, normals, random.integers(0, 256, (n_vertices, 4)).astype(np.uint8))


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriangleMesh:
    """Return an axis-aligned box: 8 corners, each of its own colour, and 12 outward faces."""
    corners = np.array(list(np.ndindex(2, 2, 2)), np.float64)
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            square = np.zeros((4, 3), int)
            square[:, axis] = side
            square[[1, 2], u] = 1
            square[[2, 3], v] = 1
            a, b, c, d = (square if side else square[::-1]) @ [4, 2, 1]
            faces += [(a, b, c), (a, c, d)]
    normals = (corners * 2 - 1) / np.sqrt(3)
    colours = np.concatenate([corners * 255, np.full((8, 1), 255)], axis=1).astype(np.uint8)
    return TriangleMesh(
        np.array(low) + corners * np.subtract(high, low), np.array(faces, np.int32), normals, colours
    )


def sphere(n: int = 40, radius: float = 1.0) -> TriangleMesh:
    """Return a closed sphere (latitude and longitude, about 2 n^2 faces); red grows with z, green with x."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, n + 1)[1:-1], np.arange(n) * 2 * np.pi / n, indexing="ij")
    ring = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    unit = np.concatenate([[[0, 0, 1.0]], ring.reshape(-1, 3), [[0, 0, -1.0]]])
    last, faces = len(unit) - 1, []
    for k in range(n):
        after = (k + 1) % n
        faces += [(0, 1 + k, 1 + after), (last, last - n + after, last - n + k)]
        for row in range(n - 2):
            a, b = 1 + row * n + k, 1 + row * n + after
            faces += [(a, a + n, b + n), (a, b + n, b)]
    colours = np.full((len(unit), 4), 255, np.uint8)
    colours[:, :2] = np.rint((unit[:, [2, 0]] + 1) / 2 * 255)
    return TriangleMesh(unit * radius, np.array(faces, np.int32), unit, colours)
