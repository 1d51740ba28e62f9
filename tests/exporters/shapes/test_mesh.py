"""Tests of TriangleMesh: what it accepts, and how it is transformed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from exporters.shapes.mesh import TriangleMesh, take_faces
from player.asset.manifest import Manifest
from player.errors import ConfigError, FormatError, ShapeError
from tests.exporters.meshes import tetrahedron


@pytest.mark.parametrize(
    ("field", "value", "error", "message"),
    [
        ("vertices", np.zeros((4, 2)), ShapeError, r"vertices: expected \[4, 3\] float32 or float64"),
        ("vertices", np.zeros((4, 3), int), ShapeError, "vertices"),
        ("vertices", np.full((4, 3), np.nan), FormatError, "finite"),
        ("faces", np.zeros((2, 3), np.int64), ShapeError, r"faces: expected \[2, 3\] int32"),
        ("faces", np.array([[0, 1, 4]], np.int32), FormatError, "expected vertex numbers 0 to 3, got 0 to 4"),
        ("faces", np.array([[0, 1, -1]], np.int32), FormatError, "got -1 to 1"),
        ("normals", np.zeros((4, 3)), FormatError, "unit length, got 0.0 at vertex 0"),
        ("normals", np.full((4, 3), np.nan), FormatError, "unit length"),
        ("normals", np.zeros((3, 3)), ShapeError, "normals"),
        ("colours", np.zeros((4, 3), np.uint8), ShapeError, "colours"),
        ("colours", np.zeros((4, 4)), ShapeError, "colours"),
    ],
)
def test_refused(field: str, value: np.ndarray, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        replace(tetrahedron(), **{field: value})


def test_transformed_by_a_similarity() -> None:
    # A quarter turn about z, twice the size, then moved far from the origin.
    matrix = np.array([[0.0, -2, 0, 1e6], [2, 0, 0, 20], [0, 0, 2, 30], [0, 0, 0, 1]])
    mesh = tetrahedron()
    moved = mesh.transformed(matrix)
    np.testing.assert_allclose(moved.vertices[2], [1e6 - 4, 20, 30], rtol=0, atol=1e-9)
    np.testing.assert_allclose(moved.normals[1], mesh.normals[1][[1, 0, 2]] * [-1, 1, 1], atol=1e-12)
    back = moved.transformed(np.linalg.inv(matrix))
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-9)


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 1, -1, 1]), np.diag([1.0, 2, 1, 1]), np.zeros((4, 4)), np.eye(3), np.full((4, 4), np.nan)],
    ids=["mirror", "stretch", "zero", "3x3", "nan"],
)
def test_transformed_refuses(matrix: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="matrix"):
        tetrahedron().transformed(matrix)


@pytest.mark.parametrize("sign", [1, -1])
def test_transformed_by_any_matrix_that_a_manifest_may_have(sign: int) -> None:
    """A `world_from_model` that is as far from a similarity as the format allows, and its inverse."""
    products = np.eye(3) + sign * 0.999e-4 * (np.arange(9) > 0).reshape(3, 3)
    matrix = np.eye(4)
    matrix[:3, :3] = 2 * np.linalg.cholesky(products).T
    Manifest(
        generator="tests", resolution=8, feature_resolution=8, step=0.1, density_range=(-1, 1), n_channels=4,
        view_size=(4, 3), world_from_model=tuple(map(tuple, matrix.tolist())),
    )  # fmt: skip
    for each in (matrix, np.linalg.inv(matrix)):
        moved = tetrahedron().transformed(each)
        np.testing.assert_allclose(moved.vertices, tetrahedron().vertices @ each[:3, :3].T, atol=1e-12)


def test_take_faces_drops_unused_vertices() -> None:
    part = take_faces(tetrahedron(), np.array([False, False, False, True]))
    assert part.vertices.tolist() == [[1, 0, 0], [0, 2, 0], [0, 0, 3]]
    assert part.faces.tolist() == [[0, 1, 2]]
    none = take_faces(tetrahedron(), np.zeros(4, bool))
    assert isinstance(none, TriangleMesh) and none.vertices.shape == (0, 3) and np.isnan(none.bounds).all()
