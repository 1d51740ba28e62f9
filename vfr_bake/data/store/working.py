"""The working size: the size of the pictures that everything after the loading of the data set works with.

A pixel of a reduced picture is the mean over the area that it covers, which leaves no gaps and no ringing
whatever the factor is. The camera is scaled by exactly the factor of its picture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from player.cameras.camera import Camera
from player.errors import DataError
from vfr_bake.data.files.masks import apply_mask
from vfr_bake.data.files.pictures import (
    BYTES_DECODED,
    DescribedView,
    enough_for,
    opencv,
    premultiplied,
    read_picture,
    straight,
    undistort,
    viewed_size,
)
from vfr_bake.data.store.capture import PosedImages

MAX_SIDE = 1600
"""Pixels of the longest side, if nothing else is asked for: a capture's field resolves no finer detail in the
minutes that it is trained for, and twelve megapixels take six times the room."""
BYTES_UNDISTORTED = 100
"""Bytes of memory for each pixel while lens distortion is undone."""


@dataclass(frozen=True)
class WorkingSize:
    """The way that pictures are reduced: to a longest side, or by a whole factor. If both are given, the
    factor decides."""

    max_side: int | None = None
    """Pixels of the longest side; None: pictures stay as large as they are."""
    downscale: int | None = None

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return the working size (width, height) of a picture of `width` x `height` pixels.

        >>> WorkingSize(1600).size(4032, 3024), WorkingSize(1600).size(400, 400)
        ((1600, 1200), (400, 400))
        >>> WorkingSize(1600, downscale=3).size(400, 299)
        (133, 99)
        """
        if self.downscale is not None:
            return max(1, width // self.downscale), max(1, height // self.downscale)
        return (width, height) if self.max_side is None else enough_for((width, height), self.max_side)

    def reading_bytes(self, view: DescribedView, size: tuple[int, int]) -> int:
        """Return the approximate number of bytes of memory that are taken while a picture of `size` is
        read."""
        bent = any(view.distortion.values())
        step = 1 if self.downscale is not None else self._whole_step(max(size))
        undone = size[0] * size[1] // step**2 * BYTES_UNDISTORTED if bent else 0
        return max(size[0] * size[1] * BYTES_DECODED, undone)

    def read(self, view: DescribedView) -> tuple[Camera, np.ndarray]:
        """Read a picture at the working size, and return its pinhole camera and the picture as [height,
        width, 4] uint8, transparent where it is masked, with the lens distortion undone. Raises DataError."""
        width, height = viewed_size(view)
        target = self.size(width, height)
        whole = self.downscale is not None or view.mask is not None
        image = read_picture(view.path, view.upright, None if whole else target)
        if view.mask is not None:
            image = apply_mask(image, view.path, view.mask, view.upright)
        # A JPEG decoder that leaves out the finest frequencies gives a half, a quarter or an eighth of the
        # size, rounded up. So the camera is divided by the whole number, and pixels added by rounding up
        # repeat the picture's edge.
        step = max(1, round(width / image.shape[1]))
        camera = _divided(view.camera.resized(width, height), step, image)
        bent = any(view.distortion.values())
        if self.downscale is not None or self.max_side is None:
            if bent:
                image = undistort(image, camera, **view.distortion)
            views = reduced(PosedImages([camera], [image]), self.downscale or 1)
            return views.cameras[0], views.images[0]
        if bent:
            # The picture is first reduced by a whole number, but not below the working size, so that the
            # interpolation blurs nothing that is kept.
            step = self._whole_step(max(image.shape[:2]))
            camera, image = resized(camera, image, -(-image.shape[1] // step), -(-image.shape[0] // step))
            image = undistort(image, camera, **view.distortion)
        return resized(camera, image, *target)

    def of(self, views: PosedImages) -> PosedImages:
        """Reduce views that are in memory to the working size, and return them."""
        if self.downscale is not None:
            return reduced(views, self.downscale)
        pairs = [
            resized(camera, image, *self.size(camera.width, camera.height))
            for camera, image in zip(views.cameras, views.images, strict=True)
        ]
        return PosedImages([camera for camera, _ in pairs], [image for _, image in pairs])

    def _whole_step(self, longest: int) -> int:
        return 1 if self.max_side is None else max(1, longest // self.max_side)


def reduced(views: PosedImages, factor: int) -> PosedImages:
    """Return the views with pixels `factor` times as large along each side, each the mean of those it
    replaces.

    Rows and columns that do not fill a pixel are cut off at the right and below. Raises DataError if nothing
    would be left.
    """
    if factor == 1:
        return views
    cameras, images = [], []
    for camera, image in zip(views.cameras, views.images, strict=True):
        height, width = image.shape[0] // factor, image.shape[1] // factor
        if min(height, width) < 1:
            raise DataError(
                f"{camera.name}: downscale: expected at most {min(image.shape[:2])}, got {factor}"
            )
        images.append(_reduced(image[: height * factor, : width * factor], factor))
        cut = replace(camera, width=width * factor, height=height * factor)
        cameras.append(cut.resized(width, height))
    return PosedImages(cameras, images)


def _reduced(image: np.ndarray, factor: int) -> np.ndarray:
    if (image[..., 3] == 255).all():
        return np.asarray(Image.fromarray(image).reduce(factor))
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return straight(premultiplied(image).reshape(height, factor, width, factor, 4).mean(axis=(1, 3)))


def resized(camera: Camera, image: np.ndarray, width: int, height: int) -> tuple[Camera, np.ndarray]:
    """Return a picture [height, width, 4] and its camera on fewer pixels, each the mean over the area that it
    covers.

    >>> camera = Camera("a", np.eye(4), 5, 5, 10.0, 10.0, 2.5, 2.5)
    >>> smaller, image = resized(camera, np.full((5, 5, 4), 255, np.uint8), 2, 2)
    >>> smaller.fx, image.shape
    (4.0, (2, 2, 4))
    """
    if image.shape[:2] == (height, width):
        return camera, image
    cv2 = opencv(f"{camera.name}: size: expected OpenCV to reduce the picture", "train")
    smaller = camera.resized(width, height)
    if (image[..., 3] == 255).all():
        return smaller, cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return smaller, straight(cv2.resize(premultiplied(image), (width, height), interpolation=cv2.INTER_AREA))


def _divided(camera: Camera, step: int, image: np.ndarray) -> Camera:
    """Return the camera of a picture that was decoded at one `step`-th of its size."""
    if step == 1:
        return camera
    height, width = image.shape[:2]
    focal = {name: getattr(camera, name) / step for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, width=width, height=height, **focal)
