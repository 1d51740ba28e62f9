"""Pictures of a field: colour = head(F, d) * A + (1 - A) * background."""

from __future__ import annotations

import numpy as np
import torch

from player.cameras import Camera
from vfr_bake.field.field import VfrField
from vfr_bake.kernels import march as kernels
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.rendering.sampling import LIMITS

HEAD_CHUNK = 8192
"""Pixels per evaluation of the head: large enough to amortise the call, small enough to stay in cache."""


def composited_features(
    field: VfrField, occupancy: OccupancyGrid, rays_o: np.ndarray, rays_d: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(features [n_rays, n_channels], opacity [n_rays], depth [n_rays]) of rays in the model frame, every
    sample used."""
    features = np.zeros((len(rays_o), field.config.n_channels), np.float32)
    opacity = np.zeros(len(rays_o), np.float32)
    depth = np.zeros(len(rays_o), np.float32)
    kernels.render_features(
        rays_o, rays_d, np.float32(occupancy.step), occupancy.distance, *field.kernel_arguments(), LIMITS,
        features, opacity, depth,
    )  # fmt: skip
    return features, opacity, depth


@torch.no_grad()
def head_colours(field: VfrField, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
    """Colours [n, 3] of composited `features` [n, n_channels] seen along unit `dirs` [n, 3]."""
    out = np.empty((len(features), 3), np.float32)
    for start in range(0, len(features), HEAD_CHUNK):
        rows = slice(start, start + HEAD_CHUNK)
        out[rows] = field.head(torch.from_numpy(features[rows]), torch.from_numpy(dirs[rows])).numpy()
    return out


def render_image(
    field: VfrField, occupancy: OccupancyGrid, camera: Camera, background: np.ndarray
) -> np.ndarray:
    """The full model's picture [height, width, 3] float32 in [0, 1] for a camera in the model frame."""
    rays_o, rays_d = camera.rays()
    features, opacity, _ = composited_features(field, occupancy, rays_o, rays_d)
    rgb = np.broadcast_to(background.astype(np.float32), (len(rays_o), 3)).copy()
    hit = np.flatnonzero(opacity > 0)
    alpha = opacity[hit, None]
    rgb[hit] = head_colours(field, features[hit], rays_d[hit]) * alpha + rgb[hit] * (1 - alpha)
    return rgb.reshape(camera.height, camera.width, 3)
