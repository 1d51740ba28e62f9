"""What surrounds the march: the pixels of blocks, their rays, and what was found into the frame; in numpy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.cameras.camera import Camera
from player.march.bounds import BLOCK
from player.march.march import MarchResult


def pixels_of_blocks(
    camera: Camera, blocks: np.ndarray, per_row: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns, rows and block of the pixels in some blocks, block after block; what sticks out is left
    away."""
    within = np.arange(BLOCK)
    top, left = np.divmod(blocks, per_row)
    shape = (len(blocks), BLOCK, BLOCK)
    rows = np.broadcast_to((top[:, None] * BLOCK + within)[:, :, None], shape).reshape(-1)
    columns = np.broadcast_to((left[:, None] * BLOCK + within)[:, None, :], shape).reshape(-1)
    owner = np.repeat(blocks, BLOCK * BLOCK)
    inside = (rows < camera.height) & (columns < camera.width)
    if inside.all():
        return columns, rows, owner
    return columns[inside], rows[inside], owner[inside]


def rays_of_pixels(
    camera: Camera, columns: np.ndarray, rows: np.ndarray, start: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rays through pixel centres, as `Camera.rays` defines them, for pixels in any order; from `start` on."""
    x = (columns + (0.5 - camera.cx)) / camera.fx
    y = (rows + (0.5 - camera.cy)) / -camera.fy
    rotation = camera.c2w[:3, :3]
    rays = np.empty((3, len(x)))
    for axis in range(3):
        rays[axis] = x * rotation[axis, 0] + y * rotation[axis, 1] - rotation[axis, 2]
    rays /= np.sqrt(rays[0] * rays[0] + rays[1] * rays[1] + rays[2] * rays[2])
    rays_d = np.ascontiguousarray(rays.T, np.float32)
    if start:
        rays_o = camera.c2w[:3, 3] + start * rays.T
        return np.ascontiguousarray(rays_o, np.float32), rays_d
    return np.broadcast_to(camera.c2w[:3, 3].astype(np.float32), rays_d.shape), rays_d


class Planes(NamedTuple):
    """What is written of the n pixels of a picture."""

    rgb: np.ndarray
    """[n, 3] float32."""
    opacity: np.ndarray
    """[n] float32."""
    depth: np.ndarray
    """[n] float32, world units."""
    n_density_samples: np.ndarray
    """[n] int32."""


def write_pixels(
    planes: Planes,
    index: np.ndarray,
    result: MarchResult,
    rgb: np.ndarray,
    behind: tuple[float, float, float] | None,
    start: float,
    scale: float,
) -> None:
    """Write what the march and the head have found for some pixels.

    Args:
        planes: of the whole picture.
        index: [n_rays] which pixels.
        result: of the march.
        rgb: [n_hits, 3] the head's colours.
        behind: the background's colour; None leaves colours as the head gives them.
        start: distance from the camera to the rays' origins, model units.
        scale: world units in a model unit.
    """
    depth = result.depth if start == 0 else np.where(result.depth > 0, result.depth + np.float32(start), 0)
    planes.opacity[index] = result.opacity
    planes.depth[index] = depth * np.float32(scale)
    planes.n_density_samples[index] = result.n_density_samples
    if behind is None:
        planes.rgb[index[result.hits]] = rgb
        return
    colours = (1 - result.opacity)[:, None] * np.asarray(behind, np.float32)
    colours[result.hits] += rgb * result.opacity[result.hits][:, None]
    planes.rgb[index] = colours
