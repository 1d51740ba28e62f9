"""Tests of simplified meshes: they have fewer faces, and the shape and colours of the source."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from exporters.mesh.simplify import simplify_mesh
from exporters.shapes.mesh import TriangleMesh, crossed_edges
from player.errors import MissingExtraError
from tests.exporters.meshes import box, random_mesh, sphere


@pytest.mark.needs("open3d")
def test_a_sphere_keeps_its_shape_and_colours() -> None:
    mesh = sphere(60)
    few = simplify_mesh(mesh, 800)
    assert len(few.faces) <= 800 < len(mesh.faces)
    radius = np.linalg.norm(few.vertices, axis=-1)
    assert 0.98 < radius.min() and radius.max() < 1.02
    unit = few.vertices / radius[:, None]
    assert (few.normals * unit).sum(axis=-1).min() > 0.97
    expected = np.rint((unit[:, [2, 0]] + 1) / 2 * 255)
    assert np.abs(few.colours[:, :2] - expected).max() < 12 and (few.colours[:, 2:] == 255).all()
    a, b, c = (few.vertices[few.faces[:, k]] for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    # 800 flat faces cut 2 % off a ball's volume; it is positive if they still look outwards
    assert abs(volume / (4 / 3 * np.pi) - 1) < 0.04


@pytest.mark.needs("open3d")
def test_a_sphere_in_the_coordinates_of_a_map_keeps_its_shape() -> None:
    mesh, middle = sphere(60), np.array([4.5e6, 5e5, 300.0])
    few = simplify_mesh(replace(mesh, vertices=mesh.vertices + middle), 800)
    areas = crossed_edges(few.vertices, few.faces) / 2
    # 800 flat faces are a little smaller than a ball
    assert 0.98 < np.linalg.norm(areas, axis=1).sum() / (4 * np.pi) < 1
    outwards = few.vertices[few.faces].mean(axis=1) - middle
    assert ((areas * outwards).sum(axis=1) > 0).all()


@pytest.mark.needs("open3d")
def test_the_same_again_and_every_vertex_used() -> None:
    first, second = simplify_mesh(sphere(30), 200), simplify_mesh(sphere(30), 200)
    for name in ("vertices", "faces", "normals", "colours"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    assert np.array_equal(np.unique(first.faces), np.arange(len(first.vertices)))


@pytest.mark.needs("open3d")
def test_alpha_is_that_of_the_nearest_vertex() -> None:
    mesh = sphere(30)
    colours = mesh.colours.copy()
    colours[:, 3] = np.where(mesh.vertices[:, 2] > 0, 255, 100)
    few = simplify_mesh(replace(mesh, colours=colours), 300)
    clear = np.abs(few.vertices[:, 2]) > 0.15
    assert np.array_equal(few.colours[clear, 3], np.where(few.vertices[clear, 2] > 0, 255, 100))


@pytest.mark.needs("open3d")
@pytest.mark.parametrize("n_faces", [50, 20, 5])
def test_where_no_edge_can_be_collapsed_vertices_are_merged(n_faces: int) -> None:
    """Edge collapse alone leaves 59 of the faces of this mesh, all of which cross each other."""
    few = simplify_mesh(random_mesh(60, 100), n_faces)
    assert 0 < len(few.faces) <= n_faces
    assert np.array_equal(np.unique(few.faces), np.arange(len(few.vertices)))


@pytest.mark.needs("open3d")
def test_merging_leaves_nearly_as_many_faces_as_were_asked_for() -> None:
    """Edge collapse alone leaves 586 of the faces of this mesh; merging in cubes of one edge leaves 162."""
    few = simplify_mesh(random_mesh(1500, 2000), 500)
    assert 400 < len(few.faces) <= 500


@pytest.mark.needs("open3d")
@pytest.mark.parametrize("mesh", [box((0, 0, 0), (1, 1, 1)), sphere(20), sphere(120)])
def test_something_is_left_of_a_closed_surface_of_one_face(mesh: TriangleMesh) -> None:
    assert 0 < len(simplify_mesh(mesh, 1).faces) <= 4


def test_enough_already_and_too_few() -> None:
    mesh = box((0, 0, 0), (1, 1, 1))
    assert simplify_mesh(mesh, 12) is mesh


def test_without_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r"needs open3d: pip install 'vfr-bake\[export\]'"):
        simplify_mesh(sphere(20), 100)
