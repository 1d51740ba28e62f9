"""Look quickly at pictures: their sharpness, their exposure, and the features that could be recognised in
them."""

from __future__ import annotations

import io
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from player.errors import DataError
from player.progress import Progress
from vfr_bake.data.check.turning import MIN_MATCHES, OFF
from vfr_bake.data.features import match
from vfr_bake.data.files.masks import apply_mask
from vfr_bake.data.files.pictures import (
    SHARPNESS_SIDE,
    decoding_bytes,
    enough_for,
    opencv,
    picture_size,
    read_picture,
    sharpness,
    shrunk,
)
from vfr_bake.data.kept_matches import SIDE
from vfr_bake.data.quality.repeats import repeats
from vfr_bake.data.quality.sharpness import blur
from vfr_bake.data.threads import n_threads, one_by_one

FEATURE_SIDE, N_FEATURES = 480, 400
"""Pixels of the longest side at which features are looked for, and the number of features that are kept."""
THUMBNAIL_SIDE = 144
MIN_SHARED = 18
"""Number of features that two pictures must share to be said to show the same. Pictures of different scenes
were seen to share up to 13."""
MOST_COMPARED = 120
"""Number of pictures, spread evenly, each of which is compared with each other: seven thousand pairs."""
GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class PictureMeasures:
    """The features and measurements of one picture."""

    size: tuple[int, int]
    """Width and height in pixels, upright."""
    sharpness: float
    """Mean square of the Laplacian of the grey levels (0 to 255) at SHARPNESS_SIDE."""
    blur: float
    """From 0 (sharp) to 1: the measure by which training leaves pictures out."""
    exposure: float
    """Mean of log2 of the luminance: one more is twice the light."""
    descriptors: np.ndarray
    """[n_features, 128] float32 of unit length."""
    points: np.ndarray
    """[n_features, 2] float32: the positions of the features, in units of the longer side from the picture's
    centre, y down."""
    levels: np.ndarray
    """[n_features] float32: log2 of the luminance around each feature."""
    thumbnail: bytes
    """A JPEG file."""


class Shared(NamedTuple):
    """The features that two pictures have in common."""

    n_features: int
    change: float
    """Brightness of these features in the second picture against that in the first, in powers of two."""
    points: tuple[np.ndarray, np.ndarray] | None = None
    """[n, 2] in each picture: the features that agree with one geometry; None unless the pictures are
    neighbours."""


def look(path: Path, mask: Path | None) -> PictureMeasures:
    """Look at what is not masked of one picture. Raises DataError, MissingExtraError."""
    cv2 = opencv(f"{path}: picture: expected OpenCV to look at it", "train")
    size = picture_size(path, upright=True)
    # A picture with a mask is decoded at its full size, because its mask has that size.
    rgba = read_picture(path, True, None if mask is not None else enough_for(size, SHARPNESS_SIDE))
    if mask is not None:
        rgba = apply_mask(rgba, path, mask, upright=True)
    small = shrunk(cv2, rgba, SHARPNESS_SIDE)
    grey = cv2.cvtColor(small, cv2.COLOR_RGBA2GRAY)
    seen = small[..., 3] > 127
    light = _light(grey)
    descriptors, points, levels = _features(cv2, small, cv2.GaussianBlur(light, (0, 0), 2))
    thumbnail = io.BytesIO()
    over_grey = Image.new("RGBA", (small.shape[1], small.shape[0]), (210, 210, 210, 255))
    over_grey.alpha_composite(Image.fromarray(small))
    over_grey.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE), Image.Resampling.BOX)
    over_grey.convert("RGB").save(thumbnail, "JPEG", quality=70)
    return PictureMeasures(
        size=size,
        sharpness=sharpness(cv2, small),
        blur=blur(small),
        exposure=float(light[seen].mean()) if seen.any() else 0.0,
        descriptors=descriptors,
        points=points,
        levels=levels,
        thumbnail=thumbnail.getvalue(),
    )


def _light(grey: np.ndarray) -> np.ndarray:
    """Return log2 of the luminance of grey levels (sRGB, uint8), as float32; 0 for white."""
    return (2.2 * np.log2((grey.astype(np.float32) + 1) / 256)).astype(np.float32)


def _features(cv2: Any, rgba: np.ndarray, light: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the descriptors [n, 128] of a picture's features, their points [n, 2], and the `light` [height,
    width] around each, [n]."""
    small = shrunk(cv2, rgba, FEATURE_SIDE)
    sift = cv2.SIFT.create(nfeatures=N_FEATURES, contrastThreshold=0.02)
    mask = np.where(small[..., 3] > 127, np.uint8(255), np.uint8(0))
    points, found = sift.detectAndCompute(cv2.cvtColor(small, cv2.COLOR_RGBA2GRAY), mask)
    if found is None:
        return np.zeros((0, 128), np.float32), np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    places = np.array([point.pt for point in points], np.float32)
    columns, rows = places.T * (len(light) / len(small))
    levels = light[rows.astype(int).clip(0, len(light) - 1), columns.astype(int).clip(0, light.shape[1] - 1)]
    middle = (np.array([small.shape[1], small.shape[0]], np.float32) - 1) / 2
    descriptors = np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1e-6))
    return descriptors, (places - middle) / max(small.shape[:2]), levels


def look_at(
    pictures: Sequence[tuple[Path, Path | None]],
    seconds: float,
    progress: Progress | None = None,
    most: int | None = None,
) -> list[PictureMeasures | str | None]:
    """Look at pictures for about `seconds`, and at no more than `most`. `pictures`: each with its mask, if it
    has one.

    Pairs of neighbours are taken in an order that spreads them over all pictures, so that those seen in the
    time are a sample of all. Returns for each picture what was seen, the reason why it cannot be read, or
    None if the time was over. Raises MissingExtraError.
    """
    end = time.monotonic() + seconds
    pairs = sorted(range((len(pictures) + 1) // 2), key=lambda pair: pair * GOLDEN % 1)
    order = [i for pair in pairs for i in (2 * pair, 2 * pair + 1) if i < len(pictures)][:most]

    def looked(number: int) -> tuple[int, PictureMeasures | str | None]:
        if time.monotonic() > end:
            return number, None
        try:
            return number, look(*pictures[number])
        except DataError as error:
            return number, str(error)

    seen: list[PictureMeasures | str | None] = [None] * len(pictures)
    # Headers of thousands of pictures on a slow disk could take all of the time.
    sized = takewhile(lambda _: time.monotonic() < end - 0.9 * seconds, order)
    masked = [(path, SHARPNESS_SIDE if mask is None else None) for path, mask in pictures]
    most_bytes = max((decoding_bytes(*masked[number]) for number in sized), default=1)
    for done, (number, found) in enumerate(one_by_one(looked, order, n_threads(most_bytes))):
        seen[number] = found
        if progress is not None:
            progress(done + 1, len(order))
    return seen


def repeated_ones(looks: Sequence[PictureMeasures | None]) -> set[int]:
    """Return the numbers of the pictures that repeat another one (`vfr_bake.data.quality.repeats`)."""
    there = [(i, seen) for i, seen in enumerate(looks) if seen is not None]
    if not there:
        return set()
    thumbnails = []
    for _, seen in there:
        with Image.open(io.BytesIO(seen.thumbnail)) as picture:
            small = picture.convert("L").resize((SIDE, SIDE), Image.Resampling.BOX)
        thumbnails.append(np.asarray(small, np.float32).reshape(-1))
    found = repeats(
        [seen for _, seen in there],
        [(seen.size[0] / max(seen.size), seen.size[1] / max(seen.size)) for _, seen in there],
        np.stack(thumbnails),
        [seen.sharpness for _, seen in there],
    )
    return {there[n][0] for n in found}


def compare(looks: Sequence[PictureMeasures | None], seconds: float) -> dict[tuple[int, int], Shared]:
    """Return what pairs (i, j), i < j, of pictures share. All neighbours in the order of the pictures are
    compared, and then, until about `seconds` are over, each picture of a sample with each other. Pairs that
    were not compared are missing."""
    end = time.monotonic() + seconds
    there = [i for i, seen in enumerate(looks) if seen is not None]
    pairs = [(i, i + 1) for i in there if i + 1 < len(looks) and looks[i + 1] is not None]
    step = max(1, -(-len(there) // MOST_COMPARED))
    sample = there[::step]
    others = [(i, j) for n, i in enumerate(sample) for j in sample[n + 1 :] if j != i + 1]
    others.sort(key=lambda pair: (pair[0] * GOLDEN + pair[1] * GOLDEN**2) % 1)
    shared = {}
    for n, (i, j) in enumerate([*pairs, *others]):
        if n >= len(pairs) and time.monotonic() > end:
            break
        a, b = looks[i], looks[j]
        assert a is not None and b is not None
        matches = match(a.descriptors, b.descriptors)
        n_shared = len(matches)
        change = float(np.median(b.levels[matches[:, 1]] - a.levels[matches[:, 0]])) if n_shared else 0.0
        points = _agreeing(a.points[matches[:, 0]], b.points[matches[:, 1]]) if n < len(pairs) else None
        shared[i, j] = Shared(n_shared, change, points)
    return shared


def _agreeing(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return those of the matched points [n, 2] and [n, 2] that agree with one geometry of the two
    pictures."""
    if len(a) < MIN_MATCHES:
        return a[:0], b[:0]
    cv2 = opencv("pictures: expected OpenCV to compare them", "train")
    _, kept = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, OFF, 0.99, 500)
    inside = np.zeros(len(a), bool) if kept is None else kept.reshape(-1) > 0
    return a[inside], b[inside]
