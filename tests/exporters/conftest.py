"""Assets to export: the shells of the player's tests with a box for a mesh, a ball and a box."""

from __future__ import annotations

from pathlib import Path

import pytest

from exporters.formats.ply import ply_bytes
from player.asset.asset import Asset, write_asset
from player.asset.bricks import pack_vertices
from player.asset.manifest import Manifest
from tests.exporters.meshes import box
from tests.exporters.solids import ball, cube, write_solid
from tests.player import conftest as shells
from tests.vertex_grids import arrays_of

collect_ignore = ["formats/blender_look.py"]  # runs inside Blender

BOX = ((1.25, 2.25, 3.0), (1.75, 2.5, 4.0))
"""Corners of the asset's mesh, world frame: three edges of different length."""

BALL_CENTRE, BALL_RADIUS = (0.05, -0.03, 0.02), 0.6
CUBE_LOW, CUBE_HIGH = (-0.5, -0.4, -0.6), (0.5, 0.3, 0.2)
"""Solids of the assets of a ball and a box, model frame."""


@pytest.fixture(scope="session")
def shells_asset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the asset of the shells, which tests must not change.

    World from model is a quarter turn, a scale of 2 and a translation.
    """
    folder = tmp_path_factory.mktemp("exports") / "asset"
    vertices, codes, features = shells.shells()
    coords, masks, _ = pack_vertices(vertices)
    manifest = Manifest(
        generator="tests",
        resolution=shells.RESOLUTION,
        feature_resolution=shells.RESOLUTION,
        step=shells.STEP,
        density_range=shells.DENSITY_RANGE,
        n_channels=4,
        view_size=(48, 40),
        world_from_model=tuple(map(tuple, shells.WORLD_FROM_MODEL)),
    )
    both = (shells.RESOLUTION, shells.RESOLUTION)
    arrays = arrays_of((coords, masks, codes), (coords, masks, features), both)
    write_asset(folder, manifest, arrays, shells.head_bytes(), ply_bytes(box(*BOX)), shells.cameras_bytes())
    return folder


@pytest.fixture(scope="session")
def opened(shells_asset: Path) -> Asset:
    return Asset.open(shells_asset)


@pytest.fixture(scope="session")
def ball_asset(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """Write a ball that spans two blocks of marching cubes along each axis. Tests must not change it."""
    return write_solid(tmp_path_factory.mktemp("ball") / "asset", ball(BALL_CENTRE, BALL_RADIUS), 72)


@pytest.fixture(scope="session")
def cube_asset(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """Write a box with edges of three different lengths. Tests must not change it."""
    return write_solid(tmp_path_factory.mktemp("cube") / "asset", cube(CUBE_LOW, CUBE_HIGH), 48)
