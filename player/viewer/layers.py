"""The layers of a frame as pictures: colour, depth, normals, opacity, number of samples."""

from __future__ import annotations

import numpy as np

from player.files.images import to_8_bit
from player.render import Frame

LAYERS = ("colour", "depth", "normals", "opacity", "samples")

# Dark blue to yellow through green, rising in lightness, so that it also reads in grey.
_MAP = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]) / 255


def layer_picture(frame: Frame, layer: str) -> np.ndarray:
    """Return the picture [h, w, 3] uint8 of one of LAYERS; the frame must have a background.

    Depth runs from yellow (near) to blue; samples run from blue (none) to yellow (most); normals are x, y, z
    as red, green and blue, in the world frame; opacity is grey.

    >>> zeros = np.zeros((1, 2), np.float32)
    >>> frame = Frame(np.ones((1, 2, 3)), np.float32([[0, 1]]), zeros, zeros, (1.0, 1.0, 1.0))
    >>> layer_picture(frame, "opacity")[0].tolist()
    [[0, 0, 0], [255, 255, 255]]
    """
    if layer == "colour":
        return frame.to_uint8()
    met = frame.opacity > 0.5
    if layer == "opacity":
        values = np.repeat(frame.opacity[..., None], 3, axis=-1)
    elif layer == "depth":
        values = np.where(met[..., None], coloured(1 - _spread(frame.depth, met)), 0)
    elif layer == "normals":
        values = np.where(met[..., None], frame.normals / 2 + 0.5, 0)
    else:
        values = coloured(frame.n_density_samples / max(float(frame.n_density_samples.max(initial=0)), 1.0))
    return to_8_bit(values)


def coloured(values: np.ndarray) -> np.ndarray:
    """Map values 0..1 [...] to colours [..., 3], 0..1."""
    at = np.linspace(0, 1, len(_MAP))
    return np.stack([np.interp(values, at, _MAP[:, channel]) for channel in range(3)], axis=-1)


def _spread(depth: np.ndarray, met: np.ndarray) -> np.ndarray:
    """Scale depth to 0..1, from the nearest hundredth of the pixels that met something to the farthest."""
    near, far = np.percentile(depth[met], [1, 99]) if met.any() else (0.0, 1.0)
    return np.clip((depth - near) / max(far - near, 1e-12), 0, 1)
