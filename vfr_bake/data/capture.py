"""Posed pictures of a data set in its own world frame: those to train on and those held out for tests."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from player.cameras.camera import Camera
from player.errors import ShapeError
from player.files.memory import give_back

HOLD_OUT_EVERY = 8


class StoredImages(Sequence[np.ndarray]):
    """Pictures that lie on a disk: each [height, width, 4] uint8 is read when it is asked for.

    They are also cut into *chunks*: each has its share of the pixels of every picture, spread over all of it,
    in one place on the disk. Who draws pixels at random draws them from one chunk after the other.
    """

    n_chunks: int

    @abstractmethod
    def some(self, numbers: Sequence[int]) -> StoredImages:
        """The pictures with these numbers."""

    @abstractmethod
    def size(self, number: int) -> tuple[int, int]:
        """Width and height of a picture, which is not read."""

    @abstractmethod
    def opaque(self, number: int) -> bool:
        """Whether all of a picture is opaque; it is not read."""

    @abstractmethod
    def pixels(self, number: int, pixels: np.ndarray) -> np.ndarray:
        """[n, 4] uint8: those of the picture's `pixels` [n], numbers in row-major order, alone."""

    @abstractmethod
    def chunk(self, number: int) -> np.ndarray:
        """[n, 3 or 4] uint8: the pixels of a chunk, picture after picture."""

    @abstractmethod
    def chunk_places(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """[n_pictures] int64 each: of which place to which the pixels of each picture lie in a chunk. The
        pixel at place p of a picture of n pixels is number `stride` p modulo n."""

    @property
    @abstractmethod
    def strides(self) -> np.ndarray:
        """[n_pictures] int64: see `chunk_places`."""


@dataclass(frozen=True)
class PosedImages:
    """Pictures and where they were taken from; each may have its own size."""

    cameras: list[Camera]
    """One a picture, of the picture's size; in the model frame in a `Scene`, in the world in a `Capture`."""
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
        """The views with these numbers, in ascending order."""
        chosen = sorted(numbers)
        cameras, images = [self.cameras[i] for i in chosen], self.images
        if isinstance(images, StoredImages):
            return PosedImages(cameras, images.some(chosen))
        return PosedImages(cameras, [images[i] for i in chosen])

    def joined(self, numbers: Sequence[int]) -> np.ndarray:
        """[n_pixels, 4] uint8: the pixels of the pictures in memory with these `numbers`, one picture behind
        the other. The pictures are parts of it from then on, so that memory holds them once.

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
        """Whether every pixel of a picture is opaque."""
        if isinstance(self.images, StoredImages):
            return self.images.opaque(number)
        return bool((self.images[number][..., 3] == 255).all())

    def pixels(self, number: int, pixels: np.ndarray) -> np.ndarray:
        """[n, 4] uint8: the `pixels` [n] of a picture, numbers in row-major order."""
        if isinstance(self.images, StoredImages):
            return self.images.pixels(number, pixels)
        return self.images[number].reshape(-1, 4)[pixels]


@dataclass(frozen=True)
class Capture:
    """Posed pictures in the world frame."""

    name: str
    train: PosedImages
    test: PosedImages
    """Views that training never sees; none when there are too few to spare one."""
    points: np.ndarray | None = None
    """[n_points, 3] points of the scene, world frame, where the data set knows some."""
    masked: bool = False
    """Whether pixels that are not opaque are masked: they say nothing, and not that nothing is there."""


def held_out(views: PosedImages) -> tuple[PosedImages, PosedImages]:
    """The views to train on and those to test with: every eighth, the first one included, where there are at
    least eight."""
    n_views = len(views.cameras)
    held = set(range(0, n_views, HOLD_OUT_EVERY)) if n_views >= HOLD_OUT_EVERY else set()
    return views.some(set(range(n_views)) - held), views.some(held)
