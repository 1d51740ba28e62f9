"""Coordinates that an export can be in (`vfr-export --frame`), as matrices from the world's coordinates.

The world's coordinates are those of the photographs' cameras (for Blender's data sets: Z up), with their
unit. A file format may add axes of its own: glTF is Y up by its specification, so the GLB writer turns the
mesh that it is given, and a Z-up program that opens the file turns it back.

| coordinates | what the numbers in the file are |
|---|---|
| `world` | the world's; in a GLB turned to Y up |
| `model` | the field's own: its box is -1..1, no unit; in a GLB turned to Y up |
| `gltf` | the world turned to Y up, (x, y, z) -> (x, z, -y), in every format |
| `blender` | those that Blender by default shows as the world: OBJ and GLB Y up, VDB half a voxel lower |
"""

from __future__ import annotations

from typing import get_args

import numpy as np

from exporters.options import Coordinates
from player.errors import ConfigError

COORDINATES = get_args(Coordinates)

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""[4, 4] matrix of (x, y, z) -> (x, z, -y), a quarter turn about x."""


def coordinates_from_world(
    coordinates: str, world_from_model: np.ndarray, file_format: str = ""
) -> np.ndarray:
    """Return the matrix from world coordinates to those that a writer is given.

    Args:
        coordinates: one of COORDINATES.
        world_from_model: [4, 4] similarity, the asset's.
        file_format: "ply", "obj", "glb", ...; GLB (turned by its writer) and OBJ (turned by Blender's reader)
            differ from the rest.

    Returns:
        [4, 4] float64 similarity.

    Raises:
        ConfigError: `coordinates` is not one of COORDINATES.

    >>> coordinates_from_world("gltf", np.eye(4), "ply")[:3, :3].tolist()
    [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    >>> bool((coordinates_from_world("gltf", np.eye(4), "glb") == np.eye(4)).all())
    True
    """
    if coordinates not in COORDINATES:
        raise ConfigError(f"frame: expected one of {', '.join(COORDINATES)}, got {coordinates}")
    if coordinates == "model":
        return np.linalg.inv(np.asarray(world_from_model, np.float64))
    if coordinates == "gltf":
        return np.eye(4) if file_format == "glb" else Y_UP.copy()
    return Y_UP.copy() if (coordinates, file_format) == ("blender", "obj") else np.eye(4)
