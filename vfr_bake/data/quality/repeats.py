"""Find pictures that show what another one shows: bursts, copies, and those of a camera that stood still.

Such pictures teach nothing new, and the mapper measures depth badly between them. Two pictures show the same
if enough of their features match and nearly all of the matches have hardly moved. A step that tells depth
moves a subject by several hundredths of the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from vfr_bake.data.features import match

MAX_SHIFT = 0.005
"""Distance by which features may move, as a share of the longer side: 8 of 1600 pixels, as with a hand that
is held still."""
QUANTILE = 0.9
"""Share of the matches that must move by less than MAX_SHIFT."""
MIN_MATCHES = 50
MIN_SHARE = 0.3
"""Smallest share of the features of either picture that must match the other's."""
SAME_SHAPE = 0.01
"""Largest relative difference of the aspect ratios of two pictures of one shape: sizes of pictures that were
made smaller are rounded."""
SAME = 1.5
"""Mean difference of two thumbnails, in grey levels of 255, below which pictures look alike. The noise of a
camera on a tripod stays below it."""


class HasFeatures(Protocol):
    """The features of a picture, for example `vfr_bake.data.features.Features`."""

    @property
    def points(self) -> np.ndarray:
        """[n, 2], in the unit of the picture's size."""
        ...

    @property
    def descriptors(self) -> np.ndarray:
        """[n, 128], of unit length."""
        ...


def repeats(
    features: Sequence[HasFeatures],
    sizes: Sequence[tuple[float, float]],
    thumbnails: np.ndarray,
    sharpness: Sequence[float],
) -> dict[int, int]:
    """Return the numbers of pictures that are not needed, each with the number of the picture that shows the
    same and is kept.

    Each picture is compared with the last one that was different, and with all whose thumbnails look alike.
    Of those that show the same, the sharpest of the largest is kept.

    `features`: of each picture, in order. `sizes`: (width, height). `thumbnails`: [n, n_pixels] grey levels.
    `sharpness`: larger for sharper.

    >>> from vfr_bake.data.features import Features
    >>> nothing = Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    >>> repeats([nothing, nothing], [(8, 6), (8, 6)], np.zeros((2, 4)), [1.0, 2.0])
    {}
    """
    groups: list[list[int]] = []
    for number in range(len(features)):
        leaders = [group[0] for group in groups]
        alike = np.abs(thumbnails[leaders] - thumbnails[number]).mean(axis=1) < SAME
        candidates = {len(groups) - 1, *np.flatnonzero(alike).tolist()} - {-1}
        for place in sorted(candidates, reverse=True):
            leader = leaders[place]
            if show_same(features[leader], features[number], sizes[leader], sizes[number]):
                groups[place].append(number)
                break
        else:
            groups.append([number])
    repeated = {}
    for group in groups:
        # Sizes that are the same but for rounding must not decide.
        least = (1 - SAME_SHAPE) * max(sizes[number][0] for number in group)
        kept = max((n for n in group if sizes[n][0] >= least), key=lambda number: sharpness[number])
        repeated |= {number: kept for number in group if number != kept}
    return dict(sorted(repeated.items()))


def show_same(
    a: HasFeatures, b: HasFeatures, size_a: tuple[float, float], size_b: tuple[float, float]
) -> bool:
    """Return whether two pictures of one shape, of sizes (width, height), show the same from the same place.
    One may be a copy of the other that was made smaller."""
    (width_a, height_a), (width_b, height_b) = size_a, size_b
    if abs(width_a * height_b - width_b * height_a) > SAME_SHAPE * width_b * height_a:
        return False
    pairs = match(a.descriptors, b.descriptors)
    if len(pairs) < max(MIN_MATCHES, MIN_SHARE * max(len(a.points), len(b.points))):
        return False
    places_a, places_b = a.points[pairs[:, 0]] / max(size_a), b.points[pairs[:, 1]] / max(size_b)
    shifts = np.linalg.norm(places_a - places_b, axis=1)
    return bool(np.quantile(shifts, QUANTILE) < MAX_SHIFT)
