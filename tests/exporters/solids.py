"""Assets of solids with a known surface: density falls by a fixed factor per voxel of distance from it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from exporters.formats.ply import ply_bytes
from player.asset.asset import Asset, write_asset
from player.asset.bricks import pack_vertices
from player.asset.density import encode_density
from player.asset.manifest import Manifest
from tests.exporters.meshes import box
from tests.player.conftest import head_bytes, look_at
from tests.vertex_grids import arrays_of

DENSITY_RANGE = (-2.0, 6.0)
AT_SURFACE = 4.0
"""Logarithm of the density at the surface, where the distance is 0."""
SLOPE = 1.5
"""Decrease of the logarithm of the density per voxel of distance."""
STORED = 3.0
"""Distance to both sides of the surface, in voxels, within which vertices are stored."""
WORLD_FROM_MODEL = [[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, 2.0], [0.0, 0.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]]

Distance = Callable[[np.ndarray], np.ndarray]
"""Function from points [n, 3], model frame, to signed distances [n], model units."""


def ball(centre: tuple[float, float, float], radius: float) -> Distance:
    return lambda points: np.linalg.norm(points - np.array(centre), axis=-1) - radius


def cube(low: tuple[float, float, float], high: tuple[float, float, float]) -> Distance:
    middle, half = np.add(low, high) / 2, np.subtract(high, low) / 2
    return lambda points: (np.abs(points - middle) - half).max(axis=-1)


def offset_of(level: float, resolution: int) -> float:
    """Return the signed distance at which the density is `level`, in model units; positive outside."""
    return (AT_SURFACE - math.log(level)) / SLOPE * 2 / resolution


def write_solid(folder: Path, distance: Distance, resolution: int, n_cameras: int = 12) -> Asset:
    """Write an asset of the solid, with features linear in the place, and cameras all around it."""
    axis = np.arange(resolution + 1)
    vertices = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    voxels = distance(vertices / resolution * 2 - 1) * resolution / 2
    vertices, voxels = vertices[np.abs(voxels) < STORED], voxels[np.abs(voxels) < STORED]
    coords, masks, order = pack_vertices(vertices)
    vertices, voxels = vertices[order], voxels[order]
    features = np.concatenate([vertices * (180 / resolution) - 90, np.full((len(vertices), 1), 50)], axis=-1)
    codes = encode_density(AT_SURFACE - SLOPE * voxels, DENSITY_RANGE)
    features = np.rint(features).astype(np.int8)
    arrays = arrays_of((coords, masks, codes), (coords, masks, features), (resolution, resolution))
    manifest = Manifest(
        generator="tests",
        resolution=resolution,
        feature_resolution=resolution,
        step=0.9 * 2 / resolution,
        density_range=DENSITY_RANGE,
        n_channels=4,
        view_size=(64, 64),
        world_from_model=tuple(map(tuple, WORLD_FROM_MODEL)),
    )
    mesh = ply_bytes(box((0.25, 1.25, 2.25), (1.75, 2.75, 3.75)))
    write_asset(folder, manifest, arrays, head_bytes(), mesh, cameras_bytes(n_cameras))
    return Asset.open(folder)


def cameras_bytes(n: int) -> bytes:
    """Return a file of n cameras of 64 x 64 pixels, on a spiral from above to below the scene's middle."""
    frames = []
    for i in range(n):
        height, angle = 0.9 - 1.8 * (i + 0.5) / n, math.pi * (3 - math.sqrt(5)) * i
        level = math.sqrt(1 - height * height)
        eye = (1 + 7 * level * math.cos(angle), 2 + 7 * level * math.sin(angle), 3 + 7 * height)
        frames.append({"file_path": f"./train/r_{i}", "transform_matrix": look_at(eye, (1, 2, 3)).tolist()})
    return json.dumps({"w": 64, "h": 64, "camera_angle_x": 0.6, "frames": frames}).encode()
