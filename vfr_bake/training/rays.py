"""Random pixels of the training pictures, as rays with their colours; witnesses and masked pixels are never
drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from player.errors import TrainingError
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.store.stored import StoredImages
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.training.detail import detail_lots

CHUNK_SHARE = 0.25
"""Number of pixels drawn from a chunk, as a share of the pixels in it. So few are drawn twice, but four times
as much is read from the disk as is used."""
RUN = 64
"""Numbers in a run, for which a `Lottery` keeps one sum: their lots, of a byte each, fill a cache line."""


@dataclass(frozen=True)
class RayBatch:
    """Rays in the model frame, and what the photographs show there."""

    rays_o: Tensor
    """[n_rays, 3] float32."""
    rays_d: Tensor
    """[n_rays, 3] float32, unit length."""
    rgba: Tensor
    """[n_rays, 4] float32 in [0, 1], straight alpha, sRGB."""
    pictures: Tensor
    """[n_rays] int64: the number of each ray's picture among those that are drawn from."""
    places: Tensor
    """[n_rays, 2] float32 in (0, 1): the pixel's centre as shares of the picture's width and height."""


@dataclass(frozen=True)
class Batch(RayBatch):
    """The rays of one step, and the random numbers drawn for them."""

    jitter: Tensor
    """[n_rays, 3] in [0, 1): shifts of the samples along each ray."""
    background: Tensor
    """[n_rays, 3] in [0, 1]: the colour behind each ray."""
    chances: Tensor
    """[n_rays] in [0, 1): decides whether a ray with a small error is learned from."""


class PicturePixels(NamedTuple):
    """Pixels of all pictures, which may differ in size: all of them, or one chunk of those on a disk
    (`vfr_bake.data.store.stored.StoredImages`). The members are arrays, or tensors on one device."""

    rgba: Any
    """[n_pixels, 4] uint8, or 3 channels if all are opaque, picture after picture."""
    starts: Any
    ends: Any
    """[n_pictures] int64: index in `rgba` of each picture's first pixel, and of the one after its last."""
    places: Any
    strides: Any
    sizes: Any
    """[n_pictures] int64: the place of each picture's first pixel in `rgba`, the picture's stride, and its
    number of pixels. The pixel at place p has the number (stride p) mod size in row-major order. If all
    pixels are here, they lie at the places 0, 1, 2,
    ... of stride 1."""
    widths: Any
    heights: Any
    """[n_pictures] int64."""
    poses: Any
    """[n_pictures, 3, 4] float32 camera to model frame."""
    intrinsics: Any
    """[n_pictures, 4] float32: fx, fy, cx, cy in pixels."""

    @classmethod
    def of(cls, views: PosedImages, joined: np.ndarray | None, chunk: int) -> PicturePixels:
        """Return the pixels of `views`: `joined` [n_pixels, 4] if they are in memory, a `chunk` if on a
        disk."""
        cameras, images = views.cameras, views.images
        sizes = np.array([camera.width * camera.height for camera in cameras])
        if isinstance(images, StoredImages):
            rgba, strides = images.chunk(chunk), images.strides
            places, behind = images.chunk_places(chunk)
        else:
            rgba = joined
            strides, places, behind = np.ones_like(sizes), np.zeros_like(sizes), sizes
        ends = np.cumsum(behind - places)
        return cls(
            rgba=rgba,
            starts=ends - (behind - places),
            ends=ends,
            places=places,
            strides=strides,
            sizes=sizes,
            widths=np.array([camera.width for camera in cameras]),
            heights=np.array([camera.height for camera in cameras]),
            poses=np.stack([camera.c2w[:3] for camera in cameras]).astype(np.float32),
            intrinsics=np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras], np.float32),
        )

    def numbers(self, view: Any, index: Any) -> Any:
        """Return the row-major numbers [n], in their pictures `view` [n], of the pixels at `index` [n]."""
        return (index - self.starts[view] + self.places[view]) * self.strides[view] % self.sizes[view]

    def directions(self, view: Any, row: Any, column: Any) -> Any:
        """Return directions [n_rays, 3], not of unit length, through the centres of pixels of the pictures
        `view` [n_rays]."""
        fx, fy, cx, cy = self.intrinsics[view].T
        x, y = (column + 0.5 - cx) / fx, (cy - row - 0.5) / fy
        poses = self.poses[view]
        return x[:, None] * poses[:, :, 0] + y[:, None] * poses[:, :, 1] - poses[:, :, 2]

    def shares(self, view: Any, row: Any, column: Any) -> tuple[Any, Any]:
        """Return the centres of pixels of the pictures `view` [n_rays], as shares [n_rays] of the picture's
        width and of its height."""
        return (column + 0.5) / self.widths[view], (row + 0.5) / self.heights[view]


class Lottery:
    """Lottery of whole numbers: each has some lots, and is drawn in proportion to them.

    >>> lottery = Lottery(np.array([0, 3, 1], np.uint8))
    >>> lottery.n_lots, lottery.numbers(np.arange(4)).tolist()
    (4, [1, 1, 1, 2])
    """

    def __init__(self, lots: np.ndarray) -> None:
        """`lots` [n] uint8: how many lots each of the numbers 0 to n - 1 has."""
        runs = np.zeros((-(-len(lots) // RUN), RUN), np.uint8)
        runs.reshape(-1)[: len(lots)] = lots
        sums = runs.sum(axis=1, dtype=np.int64)
        self.runs: Any = runs
        self.ends: Any = np.cumsum(sums)
        """[n_runs] int64: the lot after the last one of each run of RUN numbers."""
        self.n_lots = int(sums.sum())

    def to(self, device: torch.device) -> Lottery:
        """Turn this lottery's arrays into tensors on a device; return the lottery."""
        self.runs, self.ends = (torch.from_numpy(a).to(device) for a in (self.runs, self.ends))
        return self

    def numbers(self, lots: Any) -> Any:
        """Return [n] int64: the numbers that have the `lots` [n] int64, counted from 0 to n_lots - 1."""
        if isinstance(lots, Tensor):
            run = torch.searchsorted(self.ends, lots, right=True)
            sums = self.runs[run].cumsum(1, dtype=torch.int16)
        else:
            run = np.searchsorted(self.ends, lots, side="right")
            sums = self.runs[run].cumsum(1, dtype=np.int16)
        left = lots - self.ends[run] + sums[:, -1]
        return RUN * run + (sums <= left[:, None]).sum(1)


class PixelSampler:
    """Sampler of random pixels of all training pictures, except witnesses and masked pixels. All pixels are
    equally likely, or those where pictures show detail are likelier (`vfr_bake.training.detail`).

    From pictures on a disk it draws chunk by chunk: CHUNK_SHARE times as many pixels as a chunk has, then
    goes on to the next. A chunk is an even sample of all pictures, which the disk reads in one long run. As a
    pixel's neighbours are not in its chunk, its detail is not known, and all pixels are equally likely.

    It is written in numpy, because a batch is so small that torch would take longer to wake its threads for
    an operation than for the operation itself.
    """

    def __init__(
        self,
        views: PosedImages,
        generator: torch.Generator,
        witnesses: Witnesses | None = None,
        masked: bool = False,
        by_detail: bool = False,
    ) -> None:
        """`witnesses`: those of `views`; None to draw from all pixels. `masked`: whether pixels that are not
        opaque are masked; some pixels must be opaque (`vfr_bake.data.files.masks.check_masked`). `by_detail`:
        whether detail is drawn more often, if the pictures are in memory.

        Raises TrainingError: there is nothing to draw.
        """
        learned = range(len(views.cameras)) if witnesses is None else witnesses.learned().tolist()
        self._joined = None if isinstance(views.images, StoredImages) else views.joined(learned)
        self._views, self._generator, self._masked = views.some(learned), generator, masked
        patches = [] if witnesses is None else witnesses.patches(views.cameras)
        self._patches = _joined([patches[view] for view in learned if patches])
        images = self._views.images
        self._n_chunks = images.n_chunks if isinstance(images, StoredImages) else 1
        self._by_detail = by_detail and not isinstance(images, StoredImages)
        self._go_to(0)

    @property
    def position(self) -> list[int]:
        """The number of the current chunk, and how many pixels are still to be drawn from it."""
        return [self._chunk, self._n_left]

    def restore(self, position: list[int]) -> None:
        """Continue from a `position`."""
        chunk, n_left = position
        if chunk != self._chunk:
            self._go_to(chunk % self._n_chunks)
        self._n_left = n_left

    def _go_to(self, chunk: int) -> None:
        """Make `chunk` the current one, or else the next one that has something to draw."""
        for ahead in range(self._n_chunks):
            self._chunk = (chunk + ahead) % self._n_chunks
            self._pixels = PicturePixels.of(self._views, self._joined, self._chunk)
            self._lottery = self._new_lottery()
            if self._lottery.n_lots:
                self._n_left = max(1, int(CHUNK_SHARE * self._lottery.n_lots))
                return
        raise TrainingError("training pictures: expected pixels that are not masked, found none")

    def _new_lottery(self) -> Lottery:
        """Make the lottery of the current chunk, in which witnesses and masked pixels have no lots."""
        pixels = self._pixels
        if self._by_detail:
            lots = np.concatenate([detail_lots(image).reshape(-1) for image in self._views.images])
        else:
            lots = np.ones(len(pixels.rgba), np.uint8)
        if self._masked and pixels.rgba.shape[1] == 4:
            lots[pixels.rgba[:, 3] < 255] = 0
        lots[_indices(pixels, *self._patches)] = 0
        return Lottery(lots)

    def _lots_drawn(self, n_rays: int) -> Tensor:
        """Draw random lots [n_rays] int64 of the current chunk, after going on to the next if it is used
        up."""
        if self._n_chunks > 1:
            if self._n_left <= 0:
                self._go_to((self._chunk + 1) % self._n_chunks)
            self._n_left -= n_rays
        generator = self._generator
        return torch.randint(self._lottery.n_lots, (n_rays,), generator=generator, device=generator.device)

    def draw(self, n_rays: int) -> RayBatch:
        """Draw `n_rays` pixels, with replacement."""
        lots, pixels = self._lots_drawn(n_rays).numpy(), self._pixels
        index = self._lottery.numbers(lots)
        view = np.searchsorted(pixels.ends, index, side="right")
        row, column = np.divmod(pixels.numbers(view, index), pixels.widths[view])
        row, column = row.astype(np.float32), column.astype(np.float32)
        rays_d = pixels.directions(view, row, column)
        rays_d /= np.sqrt((rays_d * rays_d).sum(axis=-1, keepdims=True))
        rgba = np.ones((n_rays, 4), np.float32)
        rgba[:, : pixels.rgba.shape[1]] = pixels.rgba[index] * np.float32(1 / 255)
        return RayBatch(
            rays_o=torch.from_numpy(pixels.poses[view, :, 3]),
            rays_d=torch.from_numpy(rays_d),
            rgba=torch.from_numpy(rgba),
            pictures=torch.from_numpy(view),
            places=torch.from_numpy(np.stack(pixels.shares(view, row, column), axis=1).astype(np.float32)),
        )


class DevicePixelSampler(PixelSampler):
    """`PixelSampler` with the pixels on a GPU, 5 bytes each; its `generator` must be on that GPU."""

    def _go_to(self, chunk: int) -> None:
        super()._go_to(chunk)
        device = self._generator.device
        self._pixels = PicturePixels(*(torch.from_numpy(array).to(device) for array in self._pixels))
        self._lottery.to(device)

    def draw(self, n_rays: int) -> RayBatch:
        lots, pixels, device = self._lots_drawn(n_rays), self._pixels, self._generator.device
        index = self._lottery.numbers(lots)
        view = torch.searchsorted(pixels.ends, index, right=True)
        number, width = pixels.numbers(view, index), pixels.widths[view]
        row, column = number // width, number % width
        rays_d = pixels.directions(view, row, column)
        rgba = torch.ones((n_rays, 4), device=device)
        rgba[:, : pixels.rgba.shape[1]] = pixels.rgba[index] * (1 / 255)
        return RayBatch(
            rays_o=pixels.poses[view, :, 3],
            rays_d=torch.nn.functional.normalize(rays_d, dim=-1),
            rgba=rgba,
            pictures=view,
            places=torch.stack(pixels.shares(view, row, column), dim=1).float(),
        )


def _joined(of_views: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the view and the number, [n] int64 each, of every pixel, from the numbers of each view."""
    views = np.repeat(np.arange(len(of_views)), [len(numbers) for numbers in of_views])
    return views, np.concatenate([np.zeros(0, np.int64), *of_views])


def _indices(pixels: PicturePixels, view: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the indices int64 in `pixels` of the pixels with these row-major numbers [n] in the pictures
    `view` [n], without those that are not there; the inverse of `PicturePixels.numbers`."""
    strides = zip(pixels.strides.tolist(), pixels.sizes.tolist(), strict=True)
    inverse = np.array([pow(stride, -1, size) for stride, size in strides], np.int64)
    place = number * inverse[view] % pixels.sizes[view] - pixels.places[view]
    there = (place >= 0) & (place < (pixels.ends - pixels.starts)[view])
    return pixels.starts[view[there]] + place[there]
