"""The triangle mesh that every mesh writer takes, whose arrays are checked once; and functions for normals.

Corners of faces run counter-clockwise seen from outside. Colours are sRGB, as in a picture. Positions may be
float64, so that a world far from its origin survives the arithmetic; only the writer rounds them to float32.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from player.errors import ConfigError, FormatError, ShapeError

SIMILARITY_TOLERANCE = 3e-4
"""Largest difference of the products of a matrix's rows, over its scale squared, from those of a rotation.
Products of columns that are off by 1e-4, as a manifest's `world_from_model` may be, make up to 2.3e-4."""


class Surface(NamedTuple):
    """A mesh that has no colours yet."""

    vertices: np.ndarray
    """[n_vertices, 3] float64."""
    faces: np.ndarray
    """[n_faces, 3] int32, counter-clockwise seen from outside, where the density is lower."""
    normals: np.ndarray
    """[n_vertices, 3] float64, unit, outwards."""


@dataclass(frozen=True)
class TriangleMesh:
    """A mesh with a normal and a colour at every vertex.

    Args:
        vertices: [n_vertices, 3] float32 or float64, finite.
        faces: [n_faces, 3] int32, vertex numbers from 0, counter-clockwise seen from outside.
        normals: [n_vertices, 3] float32 or float64, of unit length (to 1e-3), pointing outwards.
        colours: [n_vertices, 4] uint8, sRGB and alpha (not premultiplied).

    Raises:
        ShapeError: an array has another shape or type.
        FormatError: a face names a vertex that is not there, a number is not finite, a normal is not of unit
            length.

    >>> up = np.tile([0.0, 0.0, 1.0], (3, 1))
    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> mesh = TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), up, np.full((3, 4), 255, np.uint8))
    >>> mesh.transformed(np.diag([2.0, 2, 2, 1])).bounds.tolist()
    [[0.0, 0.0, 0.0], [2.0, 2.0, 0.0]]
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray

    def __post_init__(self) -> None:
        n_vertices = len(self.vertices)
        for name, width, kinds in (
            ("vertices", 3, (np.float32, np.float64)),
            ("faces", 3, (np.int32,)),
            ("normals", 3, (np.float32, np.float64)),
            ("colours", 4, (np.uint8,)),
        ):
            array = getattr(self, name)
            rows = len(array) if name == "faces" else n_vertices
            if array.shape != (rows, width) or array.dtype.type not in kinds:
                types = " or ".join(np.dtype(kind).name for kind in kinds)
                raise ShapeError(
                    f"mesh: {name}: expected [{rows}, {width}] {types}, got {array.shape} {array.dtype}"
                )
        if len(self.faces) and (self.faces.min() < 0 or self.faces.max() >= n_vertices):
            raise FormatError(
                f"mesh: faces: expected vertex numbers 0 to {n_vertices - 1}, "
                f"got {self.faces.min()} to {self.faces.max()}"
            )
        if not np.isfinite(self.vertices).all():
            raise FormatError("mesh: vertices: expected finite numbers, got NaN or infinity")
        length = np.linalg.norm(self.normals, axis=-1)
        if not (np.abs(length - 1) <= 1e-3).all():
            worst = int(np.argmax(np.where(np.isfinite(length), np.abs(length - 1), np.inf)))
            raise FormatError(f"mesh: normals: expected unit length, got {length[worst]} at vertex {worst}")

    @property
    def bounds(self) -> np.ndarray:
        """Smallest and largest coordinates, [2, 3]; NaN for a mesh without vertices."""
        if not len(self.vertices):
            return np.full((2, 3), np.nan)
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    def transformed(self, matrix: np.ndarray) -> TriangleMesh:
        """Return the mesh in other coordinates. `matrix` [4, 4] is a similarity (rotation, uniform scale > 0,
        translation); the identity returns the mesh itself.

        Raises ConfigError for any other matrix: a shear or a mirror would need other normals and another
        winding.
        """
        matrix = np.asarray(matrix, np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ConfigError(f"mesh: matrix: expected [4, 4] finite numbers, got shape {matrix.shape}")
        if np.array_equal(matrix, np.eye(4)):
            return self
        linear = matrix[:3, :3]
        scale = np.cbrt(np.linalg.det(linear))
        if (
            scale <= 0
            or not np.allclose(linear @ linear.T / scale**2, np.eye(3), rtol=0, atol=SIMILARITY_TOLERANCE)
            or (matrix[3] != [0, 0, 0, 1]).any()
        ):
            raise ConfigError(
                f"mesh: matrix: expected rotation, uniform scale > 0 and translation, got {matrix.tolist()}"
            )
        vertices = self.vertices.astype(np.float64) @ linear.T + matrix[:3, 3]
        normals = self.normals.astype(np.float64) @ (linear.T / scale)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        return replace(self, vertices=vertices, normals=normals)

    def at(self, faces: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points on the mesh [n, 3] and its unit normals there [n, 3], interpolated in float64.

        Args:
            faces: [n] face numbers.
            shares: [n, 3] the weights of the face's corners (barycentric coordinates), of sum 1.
        """
        corners = self.faces[faces]
        normals = interpolated(self.normals, corners, shares)
        otherwise = self.normals[corners[:, 0]]
        return interpolated(self.vertices, corners, shares), unit(normals, otherwise, 1e-6)


def interpolated(values: np.ndarray, corners: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return mixtures [n, m] float64 of the rows of `values` [n_vertices, m] that `corners` [n, 3] names,
    weighted by `shares` [n, 3]."""
    return np.einsum("ij,ijk->ik", shares, values[corners].astype(np.float64))


def crossed_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the cross product of two edges of each face, [n_faces, 3] float64: the face's normal, with twice
    its area as its length."""
    corners = vertices.astype(np.float64)[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def unit(vectors: np.ndarray, otherwise: np.ndarray | list[float] | float, least: float = 0.0) -> np.ndarray:
    """Return vectors [n, 3] at unit length, and `otherwise`, which broadcasts, in place of a vector that is
    not longer than `least`.

    >>> unit(np.array([[0.0, 3, 4], [0, 0, 0]]), [0.0, 0, 1]).tolist()
    [[0.0, 0.6, 0.8], [0.0, 0.0, 1.0]]
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    known = length > least
    return np.where(known, vectors / np.where(known, length, 1), otherwise)


def unit_normals(
    normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray, least: float = 0.0
) -> np.ndarray:
    """Return normals [n_vertices, 3] at unit length. A normal that is not longer than `least` is
    replaced by the mean normal of the faces around its vertex, weighted by their area, or by (0,
    0, 1) where these cancel."""
    lost = ~(np.linalg.norm(normals, axis=-1) > least)
    if lost.any():
        around = np.zeros((len(vertices), 3))
        np.add.at(around, faces.T, crossed_edges(vertices, faces))
        normals = np.where(lost[:, None], around, normals)
    return unit(normals, [0.0, 0.0, 1.0])


def has_three_corners(faces: np.ndarray) -> np.ndarray:
    """Return whether the corners of each face [n_faces, 3] are three different vertices, [n_faces] bool."""
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)


def take_faces(mesh: TriangleMesh, keep: np.ndarray) -> TriangleMesh:
    """Return the mesh of the faces where `keep` [n_faces] bool is true, without the vertices that none of
    these faces uses."""
    faces = mesh.faces[keep]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    number = (np.cumsum(used) - 1).astype(np.int32)
    return TriangleMesh(mesh.vertices[used], number[faces], mesh.normals[used], mesh.colours[used])
