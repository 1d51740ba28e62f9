"""An asset of several levels in several parts, for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from player.asset.asset import GridArrays, write_asset
from player.asset.bricks import pack_vertices
from player.asset.manifest import Manifest
from player.asset.parts import LIMITS
from player.asset.pyramid import Bricks, PyramidValues, symbols_of, values_of, whole_pyramid
from player.asset.sections import Grid
from tests.player.conftest import cameras_bytes, head_bytes

RESOLUTION = 45


def cells(levels: int, thickness: float) -> list[Bricks]:
    """Return the cells of a hollow ball on each level; finer levels are towards +x."""
    centre = np.indices((RESOLUTION + 3,) * 3).reshape(3, -1).T
    found = []
    for level in range(levels):
        n = -(-RESOLUTION >> level)
        some = centre[(centre < n).all(axis=1)]
        place = (some + 0.5) / RESOLUTION * 2 ** (level + 1) - 1
        ball = np.abs(np.linalg.norm(place, axis=1) - 0.6) < thickness * 2**level
        own = np.clip(((0.3 - place[:, 0]) * levels).astype(int), 0, levels - 1) == level
        coords, masks, _ = pack_vertices(some[ball & own])
        found.append(Bricks(coords, masks))
    return found


def stored(grid: Grid, leaves: list[Bricks], n_channels: int, steps: tuple[int, ...]) -> PyramidValues:
    """Return values that vary slowly, with noise, as closely as the steps allow."""
    random = np.random.default_rng(len(leaves) + n_channels)
    pyramid, (low, high) = whole_pyramid(RESOLUTION, leaves), LIMITS[grid]
    wanted = [
        (low + high) / 2
        + 90 * np.sin(vertices.index.sum(axis=1)[:, None] * 2.0**level / 20 + np.arange(n_channels))
        + random.normal(0, 20, (vertices.n, n_channels))
        for level, vertices in enumerate(pyramid.vertices)
    ]
    symbols = symbols_of(pyramid.vertices, wanted, steps, LIMITS[grid])
    kind = np.uint8 if grid == "densities" else np.int8
    return PyramidValues(pyramid, tuple(values_of(pyramid.vertices, symbols, steps, LIMITS[grid], kind)))


STEPS = (3, 2, 1, 1)
MANIFEST = Manifest(
    generator="tests", resolution=RESOLUTION, feature_resolution=RESOLUTION, step=0.03,
    level_steps=(1, 1, 2, 4), density_range=(-2, 6), density_steps=STEPS, n_channels=9,
    feature_steps=(2, 2, 1), view_size=(48, 40),
)  # fmt: skip


def write_in_parts(folder: Path) -> Path:
    """Write the asset; return its folder."""
    arrays = GridArrays(
        stored("densities", cells(4, 0.06), 1, STEPS),
        stored("features", cells(3, 0.09), 9, (2, 2, 1)),
    )
    write_asset(folder, MANIFEST, arrays, head_bytes(9), b"ply\n", cameras_bytes())
    return folder
