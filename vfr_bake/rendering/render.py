"""Pictures of a field: colour = head(F, d) * A + (1 - A) * background."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeAlias

import numpy as np
import torch
from torch import nn

from player.cameras.camera import Camera
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.compositing import composite
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.rendering.proposals import ProposalSampler
from vfr_bake.torch_kernels.compositing import owners

HEAD_CHUNK = 8192
"""Pixels per evaluation of the head: large enough to amortise the call, small enough to stay in cache."""
SMALL = 24
"""Pixels along each side of the small pictures from which the mean colour is computed."""
PIXELS_AT_ONCE = 2**20
"""Pixels of a picture whose rays and features are held at once, in some 160 MB."""
RAY_CHUNK = 1024
"""Rays whose samples are held at once where colours are composited, with a head at each sample."""


Sampler: TypeAlias = OccupancyGrid | ProposalSampler
"""The guide that chooses where along rays a field is looked up: an object's occupancy
grid, or a scene's proposals."""


class Compositor(Protocol):
    """A sampler, or what stands for one where features are composited."""

    def composited_features(
        self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (features [n_rays, n_channels], opacity [n_rays]) of rays [n_rays, 3]."""
        ...


@torch.no_grad()
def head_colours(head: nn.Module, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
    """Return the colours [n, 3] that `head` gives composited `features` [n, n_channels] seen along unit
    `dirs` [n, 3]."""
    out = np.empty((len(features), 3), np.float32)
    for start in range(0, len(features), HEAD_CHUNK):
        rows = slice(start, start + HEAD_CHUNK)
        out[rows] = head(torch.from_numpy(features[rows]), torch.from_numpy(dirs[rows])).numpy()
    return out


def render_image(field: VfrField, sampler: Sampler, camera: Camera, background: np.ndarray) -> np.ndarray:
    """Return the full model's picture [height, width, 3] float32 in [0, 1] for a
    camera in the model frame."""
    colours, opacity = render_camera(field, sampler, camera)
    rgb = colours + (1 - opacity[:, None]) * background.astype(np.float32)
    return rgb.reshape(camera.height, camera.width, 3)


def render_camera(field: VfrField, sampler: Sampler, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return (colours times opacity [n_pixels, 3], opacity [n_pixels]) of all pixels of a camera in the model
    frame, in row-major order."""
    n_pixels = camera.width * camera.height
    colours, opacity = np.empty((n_pixels, 3), np.float32), np.empty(n_pixels, np.float32)
    for first in range(0, n_pixels, PIXELS_AT_ONCE):
        pixels = np.arange(first, min(first + PIXELS_AT_ONCE, n_pixels))
        colours[pixels], opacity[pixels] = render_rays(field, sampler, *camera.rays_through(pixels))
    return colours, opacity


def render_rays(
    field: VfrField, sampler: Sampler, rays_o: np.ndarray, rays_d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (colours times opacity [n_rays, 3], opacity [n_rays]) of rays [n_rays, 3] in the model frame."""
    render = _composited_colours if field.config.compositing == "colour" else colours_of_features
    return render(field, sampler, rays_o, rays_d)


def mean_colour(field: VfrField, sampler: Sampler, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the mean [3] of the colours that `cameras`, model frame, see over black, from
    a small picture of each."""
    small = [camera.resized(SMALL, SMALL) for camera in cameras]
    pictures = [render_image(field, sampler, camera, np.zeros(3)) for camera in small]
    return np.mean(pictures, axis=(0, 1, 2))


def colours_of_features(
    field: VfrField, sampler: Compositor, rays_o: np.ndarray, rays_d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Composite features, then colour them with one evaluation of the head per ray (equation 3): return
    (colours times opacity [n_rays, 3], opacity [n_rays])."""
    features, opacity = sampler.composited_features(field, rays_o, rays_d)
    colours = np.zeros((len(rays_o), 3), np.float32)
    hit = np.flatnonzero(opacity > 0)
    colours[hit] = head_colours(field.head, features[hit], rays_d[hit]) * opacity[hit, None]
    return colours, opacity


@torch.no_grad()
def _composited_colours(
    field: VfrField, sampler: Sampler, rays_o: np.ndarray, rays_d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Composite colours, with one evaluation of the head per sample (equation 2): return (colours times
    opacity [n_rays, 3], opacity [n_rays])."""
    colours = np.empty((len(rays_o), 3), np.float32)
    opacity = np.empty(len(rays_o), np.float32)
    for start in range(0, len(rays_o), RAY_CHUNK):
        rows = slice(start, start + RAY_CHUNK)
        samples = sampler.sample_all(field, rays_o[rows], rays_d[rows])
        sigmas = field.density(samples.features)
        dirs = torch.from_numpy(rays_d[rows])
        rays = owners(samples.starts, samples.counts, len(sigmas))
        values = field.head(samples.features, dirs[rays])
        found = composite(sigmas, values, samples.deltas, samples.starts, samples.counts)
        colours[rows], opacity[rows] = found[0].numpy(), found[1].numpy()
    return colours, opacity
