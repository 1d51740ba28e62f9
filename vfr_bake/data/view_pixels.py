"""Pixels of training views with their colours, as a model file keeps them: the witnesses
(`vfr_bake.data.witnesses`), and the training pixels, from which a bake learns what the photographs show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from player.cameras.camera import Camera
from player.march.pixels import rays_of_pixels
from vfr_bake.data.store.capture import PosedImages

N_TRAINING_PIXELS = 4_000_000
"""Number of training pixels at most: 32 MB of a model file."""
NEAR = 1 / 32
"""Distance, as a share of a view's longer side. If a view has transparent pixels, those that are farther than
this from everything else are not kept: there is nothing to learn from them."""
SEED = 21
"""Seed of the choice of training pixels."""

SomePixels = TypeVar("SomePixels", bound="ViewPixels")


@dataclass(frozen=True, eq=False)
class ViewPixels:
    """Pixels of some views, view after view."""

    counts: np.ndarray
    """[n_views] int32: number of the pixels kept of each training view."""
    pixels: np.ndarray
    """[n_pixels] int32: row * width + column within their view, ascending in each view."""
    rgba: np.ndarray
    """[n_pixels, 4] uint8: their colours, sRGB and straight alpha."""

    def views(self) -> np.ndarray:
        """Return the number of each pixel's view, [n_pixels] int64."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    def of_views(self) -> list[np.ndarray]:
        """Return `pixels` split by view."""
        return np.split(self.pixels, np.cumsum(self.counts)[:-1])

    def rays(self, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
        """Return the origins and unit directions of the pixels' rays, [n_pixels, 3] float32 each, in the
        frame of the `cameras`, one for each training view."""
        rays = []
        for camera, pixels in zip(cameras, self.of_views(), strict=True):
            rows, columns = np.divmod(pixels, camera.width)
            rays.append(rays_of_pixels(camera, columns, rows, 0.0))
        # Concatenated as they are, origins would not be contiguous: those of a view are one row, repeated.
        rays_o, rays_d = (
            np.concatenate(column, out=np.empty((len(self.pixels), 3), np.float32))
            for column in zip(*rays, strict=True)
        )
        return rays_o, rays_d

    def chosen(self: SomePixels, kept: np.ndarray) -> SomePixels:
        """Return the pixels with the numbers `kept`, ascending, or those where `kept` [n_pixels] bool is
        true.

        >>> rgba = np.array([[9, 9, 9, 255], [9, 9, 9, 0]], np.uint8)
        >>> two = ViewPixels(np.array([0, 2], np.int32), np.array([3, 5], np.int32), rgba)
        >>> second = two.chosen(np.array([1]))
        >>> second.counts.tolist(), second.pixels.tolist(), two.opaque().pixels.tolist()
        ([0, 1], [5], [3])
        """
        counts = np.bincount(self.views()[kept], minlength=len(self.counts)).astype(np.int32)
        return replace(self, counts=counts, pixels=self.pixels[kept], rgba=self.rgba[kept])

    def opaque(self: SomePixels) -> SomePixels:
        """Return the pixels that are opaque."""
        return self.chosen(self.rgba[:, 3] == 255)

    def some(self: SomePixels, n: int) -> SomePixels:
        """Return about `n` of the pixels, spread evenly, or all if there are fewer."""
        return self.chosen(np.arange(0, len(self.pixels), max(1, len(self.pixels) // n)))


def choose_training_pixels(
    views: PosedImages,
    apart: Sequence[np.ndarray],
    learned: np.ndarray,
    n: int = N_TRAINING_PIXELS,
    everywhere: bool = False,
) -> ViewPixels:
    """Choose about `n` pixels of training `views`: as many of each of the views in `learned`, spread evenly
    over it. Those that are set apart, `apart` [n_apart] int64 of each view, are left out, and so are those
    that are not near anything, but not if pixels are wanted `everywhere`.

    >>> from vfr_bake.data.demo import demo_views
    >>> train, _ = demo_views(16, 3, 1)
    >>> chosen = choose_training_pixels(train, [np.arange(9)] * 3, np.array([0, 2]))
    >>> chosen.counts[1] == 0, chosen.counts[0] > 64, len(chosen.rgba) == chosen.counts.sum()
    (np.True_, np.True_, np.True_)
    """
    random = np.random.default_rng(SEED)
    counts, pixels = np.zeros(len(views.cameras), np.int32), []
    for view in learned:
        near = None if everywhere or views.opaque(view) else _near_something(views.images[view][..., 3])
        of = views.cameras[view].width * views.cameras[view].height if near is None else len(near)
        kept = spread(min(max(n // len(learned), 1), of), of, random)
        kept = np.setdiff1d(kept if near is None else near[kept], apart[view])
        counts[view] = len(kept)
        pixels.append(kept)
    rgba = [views.pixels(view, some) for view, some in zip(learned, pixels, strict=True)]
    return ViewPixels(counts, np.concatenate(pixels).astype(np.int32), np.concatenate(rgba))


def spread(n: int, of: int, random: np.random.Generator) -> np.ndarray:
    """Draw one number at random from each of `n` equally long runs of the numbers below `of`. Returns [n]
    int64, ascending."""
    edges = np.arange(n + 1) * of // max(n, 1)
    return random.integers(edges[:-1], edges[1:])


def _near_something(alpha: np.ndarray) -> np.ndarray:
    """Return the numbers, [n] int64, of the pixels of a view that are near a pixel that is not transparent.
    `alpha`: [height, width], of the view."""
    near, radius = alpha > 0, round(NEAR * max(alpha.shape))
    for axis in (0, 1):
        wider = [(0, 0), (0, 0)]
        wider[axis] = (radius + 1, radius)
        before = np.cumsum(np.pad(near, wider), axis=axis, dtype=np.int32)
        behind = np.roll(before, -2 * radius - 1, axis=axis)
        near = np.take(behind > before, np.arange(near.shape[axis]), axis=axis)
    return np.flatnonzero(near)
