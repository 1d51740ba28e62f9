"""The work around the march, compiled by numba: pixels of blocks to rays, and results into the frame.

Each function has its readable twin in `player.march.pixels`, which gives the same to float32 rounding. The
numpy twins took a tenth of the time of a frame.
"""

from __future__ import annotations

import math

import numpy as np

from player.cameras.camera import Camera
from player.compiling import compiled
from player.march.march import MarchResult
from player.march.pixels import Planes
from player.scratch import check_scratch, scratch

F32 = np.float32


def directions(camera: Camera, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return unit directions [n, 3] float32 through pixel centres, as `Camera.rays` defines them."""
    rays_d = scratch((len(columns), 3), F32)
    lens = (camera.cx, camera.cy, camera.fx, camera.fy)
    _directions(columns, rows, lens, np.ascontiguousarray(camera.c2w[:3, :3]), rays_d)
    check_scratch(rays_d)
    return rays_d


def write_pixels(
    planes: Planes,
    index: np.ndarray,
    result: MarchResult,
    rgb: np.ndarray,
    behind: tuple[float, float, float] | None,
    start: float,
    scale: float,
) -> None:
    """Write pixels as `player.march.pixels.write_pixels` does."""
    colour = (0.0, 0.0, 0.0) if behind is None else behind
    _write(
        planes, index, result.opacity, result.depth, result.n_density_samples, result.hits, rgb,
        np.array(colour, F32), behind is None, F32(start), F32(scale),
    )  # fmt: skip


@compiled
def _directions(columns, rows, lens, rotation, rays_d):
    cx, cy, fx, fy = lens
    for i in range(len(columns)):
        x = (columns[i] + (0.5 - cx)) / fx
        y = (rows[i] + (0.5 - cy)) / -fy
        dx = x * rotation[0, 0] + y * rotation[0, 1] - rotation[0, 2]
        dy = x * rotation[1, 0] + y * rotation[1, 1] - rotation[1, 2]
        dz = x * rotation[2, 0] + y * rotation[2, 1] - rotation[2, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        rays_d[i, 0] = F32(dx / length)
        rays_d[i, 1] = F32(dy / length)
        rays_d[i, 2] = F32(dz / length)


@compiled
def _write(planes, index, opacity, depth, n_density_samples, hits, rgb, behind, transparent, start, scale):
    hit = 0
    for ray in range(len(index)):
        pixel = index[ray]
        planes.opacity[pixel] = opacity[ray]
        planes.depth[pixel] = (depth[ray] + start) * scale if depth[ray] > F32(0.0) else F32(0.0)
        planes.n_density_samples[pixel] = n_density_samples[ray]
        shaded = hit < len(hits) and hits[hit] == ray
        for c in range(3):
            if not transparent:
                colour = (F32(1.0) - opacity[ray]) * behind[c]
                planes.rgb[pixel, c] = colour + rgb[hit, c] * opacity[ray] if shaded else colour
            elif shaded:
                planes.rgb[pixel, c] = rgb[hit, c]
        if shaded:
            hit += 1
