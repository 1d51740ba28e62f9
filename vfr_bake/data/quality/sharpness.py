"""Find the pictures of a capture that are blurred: shaken, or out of focus.

The measure is that of Crete et al., "The blur effect", 2007, as scikit-image has it: blur a picture once
more, and see how much of the differences between neighbouring pixels is lost. A sharp picture loses much, a
blurred one has little to lose. The measure lies between 0 (sharp) and 1, and depends on the subject as well.
So a picture is compared only with the others of its own capture.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from player.errors import MissingExtraError, ShapeError
from player.progress import Progress
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.threads import in_threads

SIDE = 512
"""Pixels of the longest side at which blur is measured, at most. A picture that is blurred at this size is
also blurred at any larger one."""
WINDOW = 11
"""Pixels along the window with which the picture is blurred once more."""
SMALLEST = 2 * WINDOW
"""Pixels of the shortest side, at least, for blur to be measured."""
FAR_OFF, LEAST_DIFFERENCE = 5.0, 0.08
"""A picture is blurred if its blur exceeds the median by more than FAR_OFF median absolute deviations and by
more than LEAST_DIFFERENCE."""
FEWEST = 8
"""Least number of pictures among which some are called blurred: fewer have no typical one to compare with."""


def blur(image: np.ndarray) -> float:
    """Return how blurred an image [height, width, 3 or 4] uint8 is, from 0 (sharp) to 1, along its worse
    direction.

    Returns 0 where the picture is too small to tell. Raises ShapeError: it is no such image;
    MissingExtraError: no scikit-image.

    >>> noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    >>> smooth = np.cumsum(noise // 64, axis=1).astype(np.uint8)
    >>> blur(noise) < blur(np.repeat(np.repeat(noise[:16, :16], 4, axis=0), 4, axis=1))
    True
    """
    if image.ndim != 3 or image.shape[2] not in (3, 4) or image.dtype != np.uint8:
        raise ShapeError(
            f"image: expected [height, width, 3 or 4] uint8, got {list(image.shape)} {image.dtype}"
        )
    try:
        from skimage.measure import blur_effect
    except ImportError as error:
        raise MissingExtraError("blur: needs scikit-image: pip install 'vfr-bake[train]'") from error
    every = -(-max(image.shape[:2]) // SIDE)
    height, width = (side // every * every for side in image.shape[:2])
    if min(height, width) < SMALLEST * every:
        return 0.0
    grey = image[:height, :width, :3].astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32) / 255
    if image.shape[2] == 4:
        grey = grey * (image[:height, :width, 3] / np.float32(255))
    small = grey.reshape(height // every, every, width // every, every).mean(axis=(1, 3))
    if small.min() == small.max():
        return 0.0  # a plain picture has nothing that could be blurred
    return float(np.max(blur_effect(small, h_size=WINDOW)))


def blurred(blurs: Sequence[float]) -> list[int]:
    """Return the numbers, ascending, of the blurred pictures among those of one capture, from the `blur` of
    each.

    The list is empty for fewer than FEWEST pictures, and for pictures that are all alike.

    >>> blurred([0.3, 0.31, 0.29, 0.3, 0.33, 0.3, 0.6, 0.28, 0.3])
    [6]
    >>> blurred([0.6] * 9), blurred([0.1, 0.9])
    ([], [])
    """
    if len(blurs) < FEWEST:
        return []
    values = np.asarray(blurs, np.float64)
    median = float(np.median(values))
    deviation = float(np.median(np.abs(values - median)))
    limit = median + max(LEAST_DIFFERENCE, FAR_OFF * deviation)
    return np.flatnonzero(values > limit).tolist()


def without_blurred(views: PosedImages, progress: Progress | None = None) -> tuple[PosedImages, list[str]]:
    """Return the views that are not blurred, and the names of those that are.

    `progress`: called with the number of pictures done and to do.

    >>> from vfr_bake.data.demo import demo_views
    >>> views, _ = demo_views(size=64, n_train=10, n_test=0)
    >>> len(without_blurred(views)[0].images), without_blurred(views)[1]
    (10, [])
    """
    found = set(blurred(in_threads(blur, views.images, progress)))
    sharp = views.some(set(range(len(views.images))) - found)
    return sharp, [views.cameras[number].name for number in sorted(found)]
