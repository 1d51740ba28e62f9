"""Pictures that show what another one shows: bursts, copies, and a camera that stood still.

They teach nothing new, and the mapper measures depth badly between them. Two pictures show the same if nearly
all their features match and have hardly moved: a step that tells depth moves a subject by several hundredths
of the picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vfr_bake.data.features import Features, match

MAX_SHIFT = 0.005
"""Share of the longer side by which features may move: 8 of 1600 pixels, a hand that is held still."""
QUANTILE = 0.9
"""This share of the matches moves by no more than that."""
MIN_MATCHES = 50
MIN_SHARE = 0.3
"""Share of the features of either picture that match the other's, at least."""
SAME = 1.5
"""Grey levels of 255, mean difference of thumbnails: what a camera's noise is below on a tripod."""


def repeats(
    features: Sequence[Features],
    sizes: Sequence[tuple[int, int]],
    thumbnails: np.ndarray,
    sharpness: Sequence[float],
) -> dict[int, int]:
    """The numbers of pictures that are not needed, and of the picture that shows the same and is kept.

    Each picture is compared with the last one that was different, and with all that look alike at first
    sight; of those that show the same the sharpest is kept.

    `features`: of each picture, in order. `sizes`: (width, height). `thumbnails`: [n, n_pixels] grey levels.
    `sharpness`: larger for sharper.

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
            if sizes[leader] == sizes[number] and show_same(
                features[leader], features[number], sizes[number]
            ):
                groups[place].append(number)
                break
        else:
            groups.append([number])
    repeated = {}
    for group in groups:
        kept = max(group, key=lambda number: sharpness[number])
        repeated |= {number: kept for number in group if number != kept}
    return dict(sorted(repeated.items()))


def show_same(a: Features, b: Features, size: tuple[int, int]) -> bool:
    """Whether two pictures of one size (width, height) show the same from the same place."""
    pairs = match(a.descriptors, b.descriptors)
    if len(pairs) < max(MIN_MATCHES, MIN_SHARE * max(len(a.points), len(b.points))):
        return False
    shifts = np.linalg.norm(a.points[pairs[:, 0]] - b.points[pairs[:, 1]], axis=1)
    return bool(np.quantile(shifts, QUANTILE) < MAX_SHIFT * max(size))
