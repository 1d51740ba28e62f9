"""Find out whether a camera turned on the spot: two pictures then differ by a rotation alone, whatever they
show.

Letters: a point at x [2] of a picture, in units of its longer side from its centre, y down, is seen along the
ray (x / f, 1), scaled to unit length, with the focal length f in the same unit. After a rotation R on the
spot it is seen along R (x / f, 1), however far away it is; after a step it is not, unless everything is far
off. So the distance by which the best rotation misses the points is compared with the distance by which the
points have moved. Measured at 480 pixels, the former is 0.02 of the latter for a camera that is held in the
hand and turned, 0.04 if the arm that holds it turns as well, 0.17 and 0.39 on walks around a subject (can,
fox), and 0.07 along a flat wall, which hardly tells depth either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

FOCAL_LENGTHS = tuple(0.6 * 1.1**n for n in range(8))
"""Focal lengths to try: 0.6 to 1.17 of the longer side, a phone's wide lens to 42 mm. The one that explains
most is used for all pictures. With a longer one, steps along a flat wall would look like a rotation too."""
UNEXPLAINED = 0.055
"""The camera turned on the spot if the best rotation misses three in four matches by less than this share of
the distance by which the pictures have moved."""
QUANTILE = 0.75
OFF = 0.005
"""Error of the positions of features, as a share of the longer side: 2.4 of 480 pixels."""
MIN_SHIFT = 0.02
"""Pictures that moved by less than this share of the longer side do not show whether the camera turned."""
MIN_MATCHES = 30
WIDTHS = (0.1, 0.05, 0.02, OFF, OFF, OFF, OFF, OFF)


def share_turned(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> float | None:
    """Return the share of the `pairs` of pictures between which the camera turned on the spot; None if no
    pair has enough matches and movement to tell.

    `pairs`: the matched points [n, 2] and [n, 2] of two pictures that agree with one geometry, in units of
    the longer side from the centre, y down.
    """
    moved = [
        (a, b, shift)
        for a, b in pairs
        if len(a) >= MIN_MATCHES and (shift := np.median(np.linalg.norm(b - a, axis=1))) >= MIN_SHIFT
    ]
    if not moved:
        return None
    left = np.array([[off(a, b, focal) / shift for a, b, shift in moved] for focal in FOCAL_LENGTHS])
    return float((left[np.median(left, axis=1).argmin()] < UNEXPLAINED).mean())


def off(a: np.ndarray, b: np.ndarray, focal: float) -> float:
    """Return by how much the best rotation misses the points `b` [n, 2] from the points `a` [n, 2], in their
    unit: three in four are off by less. The rotation is found by least squares, reweighted with Geman and
    McClure's weights.

    >>> a = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    >>> round(off(a, a, 1.0), 6)
    0.0
    """
    before, after = _rays(a, focal), _rays(b, focal)
    weights, distances = np.ones(len(a)), np.zeros(len(a))
    for width in WIDTHS:
        u, _, vt = np.linalg.svd((after * weights[:, None]).T @ before)
        turned = before @ (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T
        distances = np.linalg.norm(focal * turned[:, :2] / np.maximum(turned[:, 2:], 1e-3) - b, axis=1)
        weights = 1 / (1 + (distances / width) ** 2) ** 2
    return float(np.quantile(distances, QUANTILE))


def _rays(points: np.ndarray, focal: float) -> np.ndarray:
    rays = np.concatenate([points / focal, np.ones((len(points), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
