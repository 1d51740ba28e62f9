"""Random pixels of the training pictures as rays with their colours."""

from __future__ import annotations

from dataclasses import dataclass

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


class PixelSampler:
    """Draws pixels uniformly from all training pictures, of whatever sizes."""

    def __init__(self, views: PosedImages, generator: torch.Generator) -> None:
        self._pixels = torch.from_numpy(np.concatenate([image.reshape(-1, 4) for image in views.images]))
        sizes = torch.tensor([image.shape[0] * image.shape[1] for image in views.images])
        self._ends = torch.cumsum(sizes, 0)
        self._starts = self._ends - sizes
        self._widths = torch.tensor([image.shape[1] for image in views.images])
        self._poses = torch.from_numpy(np.stack([c.c2w for c in views.cameras]).astype(np.float32))
        self._intrinsics = torch.tensor(
            [[c.fx, c.fy, c.cx, c.cy] for c in views.cameras], dtype=torch.float32
        )
        self._generator = generator

    def draw(self, n_rays: int) -> RayBatch:
        index = torch.randint(len(self._pixels), (n_rays,), generator=self._generator)
        view = torch.searchsorted(self._ends, index, right=True)
        pixel, width = index - self._starts[view], self._widths[view]
        row, column = pixel // width, pixel % width
        fx, fy, cx, cy = self._intrinsics[view].unbind(-1)
        x, y = (column + 0.5 - cx) / fx, -(row + 0.5 - cy) / fy
        poses = self._poses[view]
        dirs = torch.einsum("nij,nj->ni", poses[:, :3, :3], torch.stack([x, y, -torch.ones_like(x)], dim=-1))
        return RayBatch(
            rays_o=poses[:, :3, 3].contiguous(),
            rays_d=torch.nn.functional.normalize(dirs, dim=-1),
            rgba=self._pixels[index].float() / 255,
        )
