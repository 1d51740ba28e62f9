"""The frames that an export can be in, as matrices out of the world's.

World is the frame of the photographs' cameras (for Blender's data sets: Z up), with its unit. A frame is a
choice of coordinates; a file format may have axes of its own on top: glTF is Y up by its specification, so
the GLB writer turns what it is given, and whoever opens the file turns it back.

| frame | what the numbers in the file are |
|---|---|
| `world` | the world's; in a GLB turned to Y up |
| `model` | the field's own: its box is -1..1, no unit; in a GLB turned to Y up |
| `gltf` | the world turned to Y up, (x, y, z) -> (x, z, -y), in every format |
| `blender` | what Blender, left as it is, shows as the world: OBJ and GLB Y up, VDB half a voxel lower |
"""

from __future__ import annotations

import numpy as np

from player.errors import ConfigError

FRAMES = ("world", "model", "gltf", "blender")

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""[4, 4] (x, y, z) -> (x, z, -y): a quarter turn about x."""


def frame_matrix(frame: str, world_from_model: np.ndarray, file_format: str = "") -> np.ndarray:
    """What takes world coordinates to those that a writer is given.

    Args:
        frame: one of FRAMES.
        world_from_model: [4, 4] similarity, the asset's.
        file_format: "ply", "obj", "glb", ...; GLB (turned by its writer) and OBJ (turned by Blender's reader)
            differ from the rest.

    Returns:
        [4, 4] float64 similarity.

    Raises:
        ConfigError: no such frame.

    >>> frame_matrix("gltf", np.eye(4), "ply")[:3, :3].tolist()
    [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    >>> bool((frame_matrix("gltf", np.eye(4), "glb") == np.eye(4)).all())
    True
    """
    if frame not in FRAMES:
        raise ConfigError(f"frame: expected one of {', '.join(FRAMES)}, got {frame}")
    if frame == "model":
        return np.linalg.inv(np.asarray(world_from_model, np.float64))
    is_y_up = (frame == "gltf" and file_format != "glb") or (frame == "blender" and file_format == "obj")
    return Y_UP.copy() if is_y_up else np.eye(4)
