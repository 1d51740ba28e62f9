"""Tests that two other programs find an exported box at its place, in every format and frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from exporters import cli
from exporters.formats.axes import COORDINATES, coordinates_from_world
from player.errors import ConfigError
from tests.exporters.conftest import BOX
from tests.player.conftest import WORLD_FROM_MODEL

Y_UP = {  # the formats whose files hold (x, z, -y)
    "world": {"glb"},
    "model": {"glb"},
    "gltf": {"ply", "obj", "glb", "stl"},
    "blender": {"obj", "glb"},
}


def expected_bounds(frame: str, suffix: str) -> np.ndarray:
    """Return the box's bounds [2, 3] in a file, written out by hand.

    For a point (u, v, w) of the model: x = 1 - 2 v, y = 2 + 2 u, z = 3 + 2 w.
    """
    (x0, y0, z0), (x1, y1, z1) = BOX
    if frame == "model":
        (x0, x1), (y0, y1) = ((y0 - 2) / 2, (y1 - 2) / 2), ((1 - x1) / 2, (1 - x0) / 2)
        z0, z1 = (z0 - 3) / 2, (z1 - 3) / 2
    if suffix in Y_UP[frame]:
        return np.array([[x0, z0, -y1], [x1, z1, -y0]])
    return np.array([[x0, y0, z0], [x1, y1, z1]])


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb", "stl"])
@pytest.mark.parametrize("frame", COORDINATES)
def test_the_box_is_at_its_place(frame: str, suffix: str, shells_asset: Path, tmp_path: Path) -> None:
    path = tmp_path / f"box.{suffix}"
    assert cli.main([str(shells_asset), str(path), "--frame", frame, "--method", "baked"]) == 0
    expected = expected_bounds(frame, suffix)
    read = trimesh.load_mesh(path, process=False)
    np.testing.assert_allclose(read.bounds, expected, rtol=0, atol=1e-6)
    volume = np.prod(expected[1] - expected[0])
    read.merge_vertices()
    np.testing.assert_allclose(read.volume, volume, rtol=1e-5)  # positive: faces still look outwards


@pytest.mark.needs("open3d")
@pytest.mark.parametrize("suffix", ["ply", "obj", "glb", "stl"])
@pytest.mark.parametrize("frame", COORDINATES)
def test_open3d_finds_the_box_at_its_place(
    frame: str, suffix: str, shells_asset: Path, tmp_path: Path
) -> None:
    import open3d

    path, expected = tmp_path / f"box.{suffix}", expected_bounds(frame, suffix)
    assert cli.main([str(shells_asset), str(path), "--frame", frame, "--method", "baked"]) == 0
    other = open3d.io.read_triangle_mesh(str(path))
    assert len(other.triangles) == 12
    np.testing.assert_allclose([other.get_min_bound(), other.get_max_bound()], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_normals_turn_with_the_frame(suffix: str, shells_asset: Path, tmp_path: Path) -> None:
    path = tmp_path / f"box.{suffix}"
    assert cli.main([str(shells_asset), str(path), "--frame", "gltf", "--method", "baked"]) == 0
    read = trimesh.load_mesh(path, process=False, maintain_order=True)
    outwards = read.vertices - read.bounds.mean(axis=0)
    assert (np.sign(outwards) == np.sign(read.vertex_normals)).all()


def test_what_each_frame_is() -> None:
    world = np.array(WORLD_FROM_MODEL)
    corner = world @ [1, 1, 1, 1]
    in_model = coordinates_from_world("model", world, "ply")
    np.testing.assert_allclose(in_model @ corner, [1, 1, 1, 1], atol=1e-12)
    assert np.array_equal(coordinates_from_world("world", world), np.eye(4))
    assert np.array_equal(coordinates_from_world("blender", world, "stl"), np.eye(4))
    assert (coordinates_from_world("blender", world, "obj") @ [1, 2, 3, 1]).tolist() == [1, 3, -2, 1]
    with pytest.raises(ConfigError, match="expected one of world, model, gltf, blender, got unity"):
        coordinates_from_world("unity", world)
