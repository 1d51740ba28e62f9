"""Random pixels of the training pictures as rays with their colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from vfr_bake.data.capture import PosedImages


@dataclass(frozen=True)
class RayBatch:
    """Rays in the model frame and what the photographs show there."""

    rays_o: Tensor
    """[n_rays, 3] float32."""
    rays_d: Tensor
    """[n_rays, 3] float32, unit length."""
    rgba: Tensor
    """[n_rays, 4] float32 in [0, 1], straight alpha, sRGB."""


class Pixels(Protocol):
    """Draws random pixels."""

    def draw(self, n_rays: int) -> RayBatch: ...


class DevicePixelSampler:
    """`PixelSampler` with the pixels on a GPU, 4 bytes each; `generator` is of that device."""

    def __init__(self, views: PosedImages, generator: torch.Generator) -> None:
        device = generator.device
        n_pixels = torch.tensor([camera.width * camera.height for camera in views.cameras])
        pixels = np.concatenate([image.reshape(-1, 4) for image in views.images])
        self._pixels = torch.from_numpy(pixels).to(device)
        self._ends = torch.cumsum(n_pixels, dim=0).to(device)
        self._starts = self._ends - n_pixels.to(device)
        self._widths = torch.tensor([camera.width for camera in views.cameras], device=device)
        poses = np.stack([c.c2w[:3] for c in views.cameras]).astype(np.float32)
        self._poses = torch.from_numpy(poses).to(device)
        self._intrinsics = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in views.cameras], device=device)
        self._generator = generator

    def draw(self, n_rays: int) -> RayBatch:
        device = self._pixels.device
        index = torch.randint(len(self._pixels), (n_rays,), generator=self._generator, device=device)
        view = torch.searchsorted(self._ends, index, right=True)
        inside, width = index - self._starts[view], self._widths[view]
        row, column = inside // width, inside % width
        fx, fy, cx, cy = self._intrinsics[view].unbind(-1)
        x, y = (column + 0.5 - cx) / fx, (cy - row - 0.5) / fy
        poses = self._poses[view]
        rays_d = x[:, None] * poses[:, :, 0] + y[:, None] * poses[:, :, 1] - poses[:, :, 2]
        return RayBatch(
            rays_o=poses[:, :, 3].contiguous(),
            rays_d=torch.nn.functional.normalize(rays_d, dim=-1),
            rgba=self._pixels[index] * (1 / 255),
        )


class PixelSampler:
    """Draws pixels uniformly from all pixels of all training pictures, which may differ in size.

    In NumPy: a batch is so small that torch spends longer waking its threads, for every step of this, than on
    the step itself.
    """

    def __init__(self, views: PosedImages, generator: torch.Generator) -> None:
        n_pixels = np.array([camera.width * camera.height for camera in views.cameras])
        self._pixels = np.concatenate([image.reshape(-1, 4) for image in views.images])
        self._ends = np.cumsum(n_pixels)
        self._starts = self._ends - n_pixels
        self._widths = np.array([camera.width for camera in views.cameras])
        self._poses = np.stack([c.c2w[:3] for c in views.cameras]).astype(np.float32)
        self._intrinsics = np.array([[c.fx, c.fy, c.cx, c.cy] for c in views.cameras], np.float32)
        self._generator = generator

    def draw(self, n_rays: int) -> RayBatch:
        index = torch.randint(len(self._pixels), (n_rays,), generator=self._generator).numpy()
        view = np.searchsorted(self._ends, index, side="right")
        row, column = np.divmod(index - self._starts[view], self._widths[view])
        fx, fy, cx, cy = self._intrinsics[view].T
        x = (column.astype(np.float32) + np.float32(0.5) - cx) / fx
        y = (cy - row.astype(np.float32) - np.float32(0.5)) / fy
        poses = self._poses[view]
        rays_d = x[:, None] * poses[:, :, 0] + y[:, None] * poses[:, :, 1] - poses[:, :, 2]
        rays_d /= np.sqrt((rays_d * rays_d).sum(axis=-1, keepdims=True))
        return RayBatch(
            rays_o=torch.from_numpy(poses[:, :, 3].copy()),
            rays_d=torch.from_numpy(rays_d),
            rgba=torch.from_numpy(self._pixels[index] * np.float32(1 / 255)),
        )
