"""Marching cubes on fields whose surface is known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from exporters.shapes.mesh import TriangleMesh
from exporters.surface.components import extract_surface, remove_small_components
from player.errors import ConfigError, DataError, ShapeError
from tests.exporters.meshes import tetrahedron

CUBE = np.array([[-1.0, -1, -1], [1, 1, 1]])
CENTRE = np.array([0.013, -0.02, 0.031], np.float32)
RADIUS = 0.7


def soft_sphere(points: np.ndarray) -> np.ndarray:
    """Density 500 inside, falling over 0.02 units around the radius: about half a voxel at resolution 48."""
    return 500 / (1 + np.exp((np.linalg.norm(points - CENTRE, axis=-1) - RADIUS) / 0.02))


def hard_sphere(points: np.ndarray) -> np.ndarray:
    return np.where(np.linalg.norm(points - CENTRE, axis=-1) < RADIUS, 900.0, 0.0)


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6)


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() / 2)


@pytest.mark.parametrize("resolution", [24, 48])
def test_soft_sphere(resolution: int) -> None:
    voxel = 2 / resolution
    level = math.log(2) / voxel
    radius = RADIUS + 0.02 * math.log(500 / level - 1)  # where the density is the level
    vertices, faces, normals = extract_surface(soft_sphere, CUBE, resolution)
    outward = vertices - CENTRE
    distance = np.linalg.norm(outward, axis=-1)
    assert np.abs(distance - radius).max() < 0.02 * voxel  # measured: 0.012
    # A polyhedron with its corners on a sphere is smaller by O(voxel^2 / radius^2): measured 0.8 times that.
    assert signed_volume(vertices, faces) == pytest.approx(
        4 / 3 * math.pi * radius**3, rel=(voxel / radius) ** 2
    )
    assert area(vertices, faces) == pytest.approx(4 * math.pi * radius**2, rel=(voxel / radius) ** 2)
    assert len(vertices) - len(faces) / 2 == 2  # closed, one part, no hole: Euler
    angle = np.degrees(np.arccos(np.clip(np.sum(normals * outward, -1) / distance, -1, 1)))
    assert angle.max() < 1.0
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-12)
    assert vertices.dtype == np.float64 and faces.dtype == np.int32


def test_hard_sphere_is_within_half_a_voxel() -> None:
    vertices, faces, normals = extract_surface(hard_sphere, CUBE, 48)
    distance = np.linalg.norm(vertices - CENTRE, axis=-1)
    assert (
        np.abs(distance - RADIUS).max() <= 0.5 * 2 / 48 + 1e-6
    )  # no sample nearer: the midpoint is the best answer
    assert signed_volume(vertices, faces) == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.02)
    cosine = np.sum(normals * (vertices - CENTRE), -1) / distance
    assert cosine.min() > 0.5 and cosine.mean() > 0.9


def test_box_that_is_no_cube_and_progress() -> None:
    aabb = np.array([[10.0, 20, 30], [12, 24, 31]])
    shares: list[float] = []

    def slab(points: np.ndarray) -> np.ndarray:
        return np.exp(20 * (22.3 - points[:, 1]))

    vertices, _, normals = extract_surface(slab, aabb, 40, level=1.0, progress=shares.append)
    np.testing.assert_allclose(vertices[:, 1], 22.3, atol=1e-4)
    np.testing.assert_allclose(vertices.min(0)[[0, 2]], aabb[0, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(vertices.max(0)[[0, 2]], aabb[1, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(normals, np.tile([0.0, 1, 0], (len(normals), 1)), atol=1e-3)
    assert shares[-1] == 1.0 and shares == sorted(shares)


def test_level_exactly_on_samples_leaves_no_empty_face() -> None:
    level = math.log(2) * 32

    def steps(points: np.ndarray) -> np.ndarray:
        return np.where(
            np.abs(points).max(-1) < 0.5, 900.0, np.where(np.abs(points).max(-1) == 0.5, level, 1e-3)
        )

    vertices, faces, _ = extract_surface(steps, CUBE, 64)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=-1).min() > 0
    np.testing.assert_allclose(np.abs(vertices).max(0), 0.5)
    assert signed_volume(vertices, faces) == pytest.approx(1.0, rel=1e-2)


def test_refusals() -> None:
    with pytest.raises(DataError, match="expected some in the box"):
        extract_surface(lambda points: np.zeros(len(points)), CUBE, 8)
    with pytest.raises(ConfigError, match=r"level: expected a density between 1e-05 and 0\.5"):
        extract_surface(lambda points: np.where(points[:, 0] > 0, 0.5, 1e-5), CUBE, 8)
    with pytest.raises(ConfigError, match="level: expected a density > 0"):
        extract_surface(soft_sphere, CUBE, 8, level=0.0)
    with pytest.raises(DataError, match="expected numbers >= 0, got nan"):
        extract_surface(lambda points: np.full(len(points), np.nan), CUBE, 8)
    with pytest.raises(DataError, match="expected numbers >= 0, got -1"):
        extract_surface(lambda points: np.full(len(points), -1.0), CUBE, 8)
    with pytest.raises(DataError, match=r"expected \[729\] values"):
        extract_surface(lambda points: points, CUBE, 8)
    with pytest.raises(ShapeError, match="aabb"):
        extract_surface(soft_sphere, CUBE.T, 8)
    with pytest.raises(ConfigError, match="aabb"):
        extract_surface(soft_sphere, CUBE[::-1], 8)
    with pytest.raises(ConfigError, match="resolution"):
        extract_surface(soft_sphere, CUBE, 1)


def test_infinite_density_is_solid() -> None:
    vertices, _, _ = extract_surface(lambda points: np.where(points[:, 2] < 0.1, np.inf, 0.0), CUBE, 10)
    np.testing.assert_allclose(vertices[:, 2], 0.1, atol=1e-6)


def two_parts() -> TriangleMesh:
    one = tetrahedron()
    return TriangleMesh(
        np.concatenate([one.vertices, one.vertices[:3] + 9, one.vertices[:1]]),  # the last belongs to no face
        np.concatenate([one.faces, [[4, 5, 6]]]).astype(np.int32),
        np.concatenate([one.normals, one.normals[:3], one.normals[:1]]),
        np.concatenate([one.colours, one.colours[:3], one.colours[:1]]),
    )


def test_floaters_are_removed() -> None:
    mesh, n_removed = remove_small_components(two_parts(), 0.25)
    assert n_removed == 1
    assert mesh.vertices.tolist() == tetrahedron().vertices.tolist()
    assert mesh.faces.tolist() == tetrahedron().faces.tolist()
    assert remove_small_components(two_parts(), 0.2)[1] == 0  # exactly the share: stays
    assert remove_small_components(two_parts(), 1.0)[1] == 1  # the largest part always stays
    empty = replace(mesh, faces=mesh.faces[:0])
    assert remove_small_components(empty, 0.5) == (empty, 0)
    with pytest.raises(ConfigError, match="min_fraction"):
        remove_small_components(mesh, 2.0)
