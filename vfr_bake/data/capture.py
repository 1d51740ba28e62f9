"""Posed pictures of a data set in its own world frame: those to train on and those held out for tests."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from player.cameras.camera import Camera
from player.errors import ShapeError

HOLD_OUT_EVERY = 8


@dataclass(frozen=True)
class PosedImages:
    """Pictures and where they were taken from; each may have its own size."""

    cameras: list[Camera]
    """One a picture, of the picture's size; in the model frame in a `Scene`, in the world in a `Capture`."""
    images: list[np.ndarray]
    """[height, width, 4] uint8 each, sRGB and straight (not premultiplied) alpha."""

    def __post_init__(self) -> None:
        if len(self.images) != len(self.cameras):
            raise ShapeError(f"images: expected {len(self.cameras)}, one a camera, got {len(self.images)}")
        for camera, image in zip(self.cameras, self.images, strict=True):
            shape = image.shape
            if len(shape) != 3 or shape[2] != 4 or image.dtype != np.uint8:
                raise ShapeError(
                    f"{camera.name}: image: expected [height, width, 4] uint8, "
                    f"got {list(shape)} {image.dtype}"
                )
            if (camera.height, camera.width) != shape[:2]:
                raise ShapeError(
                    f"{camera.name}: camera: expected {shape[1]}x{shape[0]} pixels as its picture has, "
                    f"got {camera.width}x{camera.height}"
                )

    def some(self, numbers: Iterable[int]) -> PosedImages:
        """The views with these numbers, in ascending order."""
        chosen = sorted(numbers)
        return PosedImages([self.cameras[i] for i in chosen], [self.images[i] for i in chosen])


@dataclass(frozen=True)
class Capture:
    """Posed pictures in the world frame."""

    name: str
    train: PosedImages
    test: PosedImages
    """Views that training never sees; none when there are too few to spare one."""
    points: np.ndarray | None = None
    """[n_points, 3] points of the scene, world frame, where the data set knows some."""


def held_out(views: PosedImages) -> tuple[PosedImages, PosedImages]:
    """The views to train on and those to test with: every eighth, the first one included, where there are at
    least eight."""
    n_views = len(views.cameras)
    held = set(range(0, n_views, HOLD_OUT_EVERY)) if n_views >= HOLD_OUT_EVERY else set()
    return views.some(set(range(n_views)) - held), views.some(held)
