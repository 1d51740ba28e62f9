"""Random pixels of the training pictures, all but the witnesses, as rays with their colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from vfr_bake.data.capture import PosedImages
from vfr_bake.data.witnesses import Witnesses


@dataclass(frozen=True)
class RayBatch:
    """Rays in the model frame and what the photographs show there."""

    rays_o: Tensor
    """[n_rays, 3] float32."""
    rays_d: Tensor
    """[n_rays, 3] float32, unit length."""
    rgba: Tensor
    """[n_rays, 4] float32 in [0, 1], straight alpha, sRGB."""


class Pixels(NamedTuple):
    """All pixels of all pictures, which may differ in size; arrays, or tensors on one device."""

    rgba: Any
    """[n_pixels, 4] uint8, picture after picture, row after row."""
    starts: Any
    ends: Any
    """[n_pictures] int64: the first pixel of each picture, and the one behind its last."""
    widths: Any
    """[n_pictures] int64."""
    poses: Any
    """[n_pictures, 3, 4] float32 camera to model frame."""
    intrinsics: Any
    """[n_pictures, 4] float32: fx, fy, cx, cy in pixels."""

    @classmethod
    def of(cls, views: PosedImages) -> Pixels:
        cameras = views.cameras
        n_pixels = np.array([camera.width * camera.height for camera in cameras])
        ends = np.cumsum(n_pixels)
        return cls(
            rgba=np.concatenate([image.reshape(-1, 4) for image in views.images]),
            starts=ends - n_pixels,
            ends=ends,
            widths=np.array([camera.width for camera in cameras]),
            poses=np.stack([camera.c2w[:3] for camera in cameras]).astype(np.float32),
            intrinsics=np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras], np.float32),
        )

    def directions(self, view: Any, row: Any, column: Any) -> Any:
        """Directions [n_rays, 3], not of unit length, through the centres of pixels of the pictures `view`
        [n_rays]."""
        fx, fy, cx, cy = self.intrinsics[view].T
        x, y = (column + 0.5 - cx) / fx, (cy - row - 0.5) / fy
        poses = self.poses[view]
        return x[:, None] * poses[:, :, 0] + y[:, None] * poses[:, :, 1] - poses[:, :, 2]


class PixelSampler:
    """Draws pixels uniformly from all pixels of all training pictures that are no witnesses.

    In numpy: a batch is so small that torch spends longer waking its threads, for every step of this, than on
    the step itself.
    """

    def __init__(
        self, views: PosedImages, generator: torch.Generator, witnesses: Witnesses | None = None
    ) -> None:
        """`witnesses`: of `views`; with None all pixels are drawn."""
        learned = range(len(views.cameras)) if witnesses is None else witnesses.learned()
        self._pixels, self._generator = Pixels.of(views.some(learned)), generator
        kept = np.zeros(0, np.int64) if witnesses is None else _single_pixels(witnesses, self._pixels.starts)
        self._n_drawn = len(self._pixels.rgba) - len(kept)
        self._n_before: Any = kept - np.arange(len(kept))
        """[n_single] int64, ascending: the number of pixels that are drawn before each single witness."""

    def draw(self, n_rays: int) -> RayBatch:
        """`n_rays` pixels, with replacement."""
        pixels = self._pixels
        index = torch.randint(self._n_drawn, (n_rays,), generator=self._generator).numpy()
        index += np.searchsorted(self._n_before, index, side="right")
        view = np.searchsorted(pixels.ends, index, side="right")
        row, column = np.divmod(index - pixels.starts[view], pixels.widths[view])
        rays_d = pixels.directions(view, row.astype(np.float32), column.astype(np.float32))
        rays_d /= np.sqrt((rays_d * rays_d).sum(axis=-1, keepdims=True))
        return RayBatch(
            rays_o=torch.from_numpy(pixels.poses[view, :, 3]),
            rays_d=torch.from_numpy(rays_d),
            rgba=torch.from_numpy(pixels.rgba[index] * np.float32(1 / 255)),
        )


class DevicePixelSampler(PixelSampler):
    """`PixelSampler` with the pixels on a GPU, 4 bytes each; `generator` is of that device."""

    def __init__(
        self, views: PosedImages, generator: torch.Generator, witnesses: Witnesses | None = None
    ) -> None:
        super().__init__(views, generator, witnesses)
        self._pixels = Pixels(*(torch.from_numpy(array).to(generator.device) for array in self._pixels))
        self._n_before = torch.from_numpy(self._n_before).to(generator.device)

    def draw(self, n_rays: int) -> RayBatch:
        pixels, device = self._pixels, self._generator.device
        index = torch.randint(self._n_drawn, (n_rays,), generator=self._generator, device=device)
        index += torch.searchsorted(self._n_before, index, right=True)
        view = torch.searchsorted(pixels.ends, index, right=True)
        inside, width = index - pixels.starts[view], pixels.widths[view]
        rays_d = pixels.directions(view, inside // width, inside % width)
        return RayBatch(
            rays_o=pixels.poses[view, :, 3],
            rays_d=torch.nn.functional.normalize(rays_d, dim=-1),
            rgba=pixels.rgba[index] * (1 / 255),
        )


def _single_pixels(witnesses: Witnesses, starts: np.ndarray) -> np.ndarray:
    """[n_single] int64, ascending: the single witnesses among all pixels of the learned views, of which each
    begins at `starts` [n_learned]."""
    first = np.full(len(witnesses.counts), -1)
    first[witnesses.learned()] = starts
    of_view = first[witnesses.views()]
    single = of_view >= 0
    return of_view[single] + witnesses.pixels[single]
