"""The work around the march, in numpy: pixels of blocks to rays, and results into the frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.cameras.camera import Camera
from player.march.bounds import BLOCK
from player.march.march import MarchResult


class Pixels(NamedTuple):
    """Some pixels of a picture."""

    columns: np.ndarray
    """[n] int64."""
    rows: np.ndarray
    """[n] int64."""
    blocks: np.ndarray
    """[n] int64, the block that each pixel is in."""

    def only(self, which: np.ndarray) -> Pixels:
        """Return the pixels that `which`, an index into an array, chooses."""
        return Pixels(self.columns[which], self.rows[which], self.blocks[which])


def z_curve(n: int) -> np.ndarray:
    """Return row and column [n * n, 2] of the pixels of a square of n by n, n a power of two, along a Z curve
    (Morton order).

    Each quarter of the curve covers a quarter of the square. So pixels that are marched together lie close
    together in both directions, and meet nearly the same bricks.

    >>> z_curve(4)[:8].tolist()
    [[0, 0], [0, 1], [1, 0], [1, 1], [0, 2], [0, 3], [1, 2], [1, 3]]
    """
    if n == 1:
        return np.zeros((1, 2), np.int64)
    half, corners = z_curve(n // 2), np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    return (n // 2 * corners[:, None] + half).reshape(-1, 2)


EVERY = z_curve(BLOCK)
"""[64, 2] row and column, within a block, of each of its pixels."""


def pixels_of_blocks(camera: Camera, blocks: np.ndarray, per_row: int, within: np.ndarray = EVERY) -> Pixels:
    """List the pixels in some blocks, block after block; pixels outside the picture are left out.

    Args:
        camera: gives the size of the picture.
        blocks: [n_blocks] numbers of blocks, row by row.
        per_row: blocks in a row of the picture.
        within: [m, 2] row and column of the pixels in each block.
    """
    top, left = np.divmod(blocks, per_row)
    rows = (top[:, None] * BLOCK + within[:, 0]).reshape(-1)
    columns = (left[:, None] * BLOCK + within[:, 1]).reshape(-1)
    pixels = Pixels(columns, rows, np.repeat(blocks, len(within)))
    inside = (rows < camera.height) & (columns < camera.width)
    return pixels if inside.all() else pixels.only(inside)


def rays_of_pixels(
    camera: Camera, columns: np.ndarray, rows: np.ndarray, start: float
) -> tuple[np.ndarray, np.ndarray]:
    """Make rays through pixel centres, as `Camera.rays` defines them, for pixels in any order. The rays begin
    at the distance `start`, model units, from the camera."""
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
    """The arrays of a picture of n pixels, into which results are written."""

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
    """Write the results of the march and of the head for some pixels.

    Args:
        planes: arrays of the whole picture.
        index: [n_rays] the pixel of each ray, as an index into the planes.
        result: the result of the march of these rays.
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
