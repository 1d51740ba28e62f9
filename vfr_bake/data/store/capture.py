"""Posed pictures of a data set in its own world frame: those to train on and those held out for tests."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from player.cameras.camera import Camera
from player.errors import ShapeError
from player.files.memory import give_back
from vfr_bake.data.store.stored import StoredImages

HOLD_OUT_EVERY = 8


@dataclass(frozen=True)
class PosedImages:
    """Pictures and the cameras that took them. Each picture may have its own size."""

    cameras: list[Camera]
    """One for each picture, of the picture's size; in the model frame in a `Scene`, in the world in a
    `Capture`."""
    images: list[np.ndarray] | StoredImages
    """[height, width, 4] uint8 each, sRGB and straight (not premultiplied) alpha; in memory or on a disk."""

    def __post_init__(self) -> None:
        if len(self.images) != len(self.cameras):
            raise ShapeError(f"images: expected {len(self.cameras)}, one a camera, got {len(self.images)}")
        for index, camera in enumerate(self.cameras):
            if isinstance(self.images, StoredImages):
                width, height = self.images.size(index)
                self._check_size(camera, (height, width))
                continue
            image = self.images[index]
            shape = image.shape
            if len(shape) != 3 or shape[2] != 4 or image.dtype != np.uint8:
                raise ShapeError(
                    f"{camera.name}: image: expected [height, width, 4] uint8, "
                    f"got {list(shape)} {image.dtype}"
                )
            self._check_size(camera, shape)

    def _check_size(self, camera: Camera, shape: tuple[int, ...]) -> None:
        if (camera.height, camera.width) != shape[:2]:
            raise ShapeError(
                f"{camera.name}: camera: expected {shape[1]}x{shape[0]} pixels as its picture has, "
                f"got {camera.width}x{camera.height}"
            )

    def some(self, numbers: Iterable[int]) -> PosedImages:
        """Return the views with these numbers, in ascending order."""
        chosen = sorted(numbers)
        cameras, images = [self.cameras[i] for i in chosen], self.images
        if isinstance(images, StoredImages):
            return PosedImages(cameras, images.some(chosen))
        return PosedImages(cameras, [images[i] for i in chosen])

    def joined(self, numbers: Sequence[int]) -> np.ndarray:
        """Return the pixels, [n_pixels, 4] uint8, of the pictures with these `numbers`, one picture behind
        the other; the pictures must be in memory. From then on they are parts of the returned array, so that
        memory holds them once.

        >>> from vfr_bake.data.demo import demo_capture
        >>> train = demo_capture(size=16, n_train=4, n_test=1).train
        >>> pixels = train.joined([1, 3])
        >>> pixels.shape, bool(np.shares_memory(pixels, train.images[3]))
        ((512, 4), True)
        """
        assert isinstance(self.images, list)
        pixels = np.concatenate([self.images[i].reshape(-1, 4) for i in numbers])
        end = 0
        for i in numbers:
            camera = self.cameras[i]
            begin, end = end, end + camera.height * camera.width
            self.images[i] = pixels[begin:end].reshape(camera.height, camera.width, 4)
        give_back()
        return pixels

    def opaque(self, number: int) -> bool:
        """Return whether every pixel of a picture is opaque."""
        if isinstance(self.images, StoredImages):
            return self.images.opaque(number)
        return bool((self.images[number][..., 3] == 255).all())

    def pixels(self, number: int, pixels: np.ndarray) -> np.ndarray:
        """Return the colours, [n, 4] uint8, of the `pixels` [n] of a picture, numbered in row-major order."""
        if isinstance(self.images, StoredImages):
            return self.images.pixels(number, pixels)
        return self.images[number].reshape(-1, 4)[pixels]


@dataclass(frozen=True)
class Capture:
    """Posed pictures in the world frame."""

    name: str
    train: PosedImages
    test: PosedImages
    """Views that training never sees; empty if there are too few to spare one."""
    points: np.ndarray | None = None
    """[n_points, 3]: points of the scene in the world frame, if the data set has some."""
    masked: bool = False
    """Whether pixels that are not opaque are masked, so that nothing is known of what is there. Otherwise
    they say that nothing is there."""
    transparent: bool = False
    """Whether pictures that have masks have transparent surroundings, too. Both are transparent pixels."""


def held_out(views: PosedImages) -> tuple[PosedImages, PosedImages]:
    """Return the views to train on and the views to test with. If there are at least eight views, every
    eighth is a test view, the first one included."""
    n_views = len(views.cameras)
    held = set(range(0, n_views, HOLD_OUT_EVERY)) if n_views >= HOLD_OUT_EVERY else set()
    return views.some(set(range(n_views)) - held), views.some(held)
