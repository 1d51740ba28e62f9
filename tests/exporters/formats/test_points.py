"""Tests of point clouds: points are spread evenly over the surface, and two other programs read them."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from exporters.formats.parity import check_points_bytes
from exporters.formats.points import parse_points, points_bytes, sample_points
from player.errors import DataError, FormatError, ParityError
from tests.exporters.meshes import box, sphere


def test_evenly_over_the_area() -> None:
    mesh = box((0, 0, 0), (1, 2, 4))
    cloud = sample_points(mesh, 28_000)  # area 28
    on = {
        "x": (cloud.vertices[:, 0] < 1e-9),
        "y": (cloud.vertices[:, 1] < 1e-9),
        "z": (cloud.vertices[:, 2] < 1e-9),
    }
    # sampling is stratified: a triangle's count differs from its share by a point or two
    assert (
        abs(on["x"].sum() - 8000) <= 4 and abs(on["y"].sum() - 4000) <= 4 and abs(on["z"].sum() - 2000) <= 4
    )
    assert (cloud.vertices >= 0).all() and (cloud.vertices <= np.array([1, 2, 4]) + 1e-12).all()
    quarter = on["x"] & (cloud.vertices[:, 1] < 1) & (cloud.vertices[:, 2] < 2)
    assert abs(quarter.sum() - 2000) < 5 * np.sqrt(2000)


def test_normals_and_colours_are_the_surface_s() -> None:
    cloud = sample_points(sphere(60), 500)
    unit = cloud.vertices / np.linalg.norm(cloud.vertices, axis=-1, keepdims=True)
    assert (unit * cloud.normals).sum(axis=-1).min() > 0.999
    assert np.abs(cloud.colours[:, 0] - (unit[:, 2] + 1) / 2 * 255).max() < 3


def test_the_same_again() -> None:
    assert points_bytes(sample_points(sphere(10), 99)) == points_bytes(sample_points(sphere(10), 99))


def test_other_programs_read(tmp_path: Path) -> None:
    cloud = sample_points(sphere(20), 200)
    data = points_bytes(cloud)
    read = trimesh.load(io.BytesIO(data), file_type="ply")
    assert isinstance(read, trimesh.PointCloud)
    np.testing.assert_allclose(read.vertices, cloud.vertices, rtol=0, atol=1e-6)
    assert np.array_equal(read.colors, cloud.colours)


@pytest.mark.needs("open3d")
def test_open3d_reads_the_points(tmp_path: Path) -> None:
    import open3d

    cloud = sample_points(sphere(20), 200)
    (tmp_path / "points.ply").write_bytes(points_bytes(cloud))
    other = open3d.io.read_point_cloud(str(tmp_path / "points.ply"))
    np.testing.assert_allclose(np.asarray(other.points), cloud.vertices, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(other.normals), cloud.normals, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(other.colors), cloud.colours[:, :3] / 255, rtol=0, atol=1e-6)


def test_hard_inputs() -> None:
    mesh = box((0, 0, 0), (1, 1, 1))
    assert len(sample_points(mesh, 1).vertices) == 1
    with pytest.raises(DataError, match="some area"):
        sample_points(replace(mesh, faces=mesh.faces[:0]), 5)
    with pytest.raises(DataError, match="some area"):
        sample_points(replace(mesh, faces=np.array([[0, 0, 1]], np.int32)), 5)
    flat = replace(mesh, faces=np.concatenate([[[0, 0, 1]], mesh.faces, [[2, 2, 2]]]).astype(np.int32))
    assert np.isfinite(sample_points(flat, 100).vertices).all()


def test_parity() -> None:
    cloud = sample_points(sphere(10), 50)
    data = points_bytes(cloud)
    check_points_bytes(data, cloud, "p.ply")
    with pytest.raises(ParityError, match="points: number"):
        check_points_bytes(data, replace(cloud, vertices=cloud.vertices + 1e-3), "p.ply")
    with pytest.raises(ParityError, match="colours"):
        check_points_bytes(data, replace(cloud, colours=cloud.colours[::-1].copy()), "p.ply")
    with pytest.raises(FormatError, match="expected a point cloud"):
        parse_points(data[:-1], "p.ply")
