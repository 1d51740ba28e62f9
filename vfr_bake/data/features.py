"""SIFT features of pictures, and the matching of features between two pictures.

The features are OpenCV's, and the matching is one matrix product: on a CPU both are an order of magnitude
faster than pycolmap's own. Also, pictures are then decoded as everywhere else in the project, whatever their
format. A point (x, y) is in pixels of the picture, with the centre of the first pixel at (0.5, 0.5), as in
COLMAP.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from player.progress import Progress
from vfr_bake.data.files.pictures import opencv, shrunk

MAX_SIDE = 1600
"""Pixels of the longer side to which pictures are reduced before features are looked for. Beyond it, a
photograph's finest grain is noise and sharpening, which no other picture repeats, and time grows with the
pixels."""
MAX_FEATURES = 3072
"""Number of features of a picture, at most. The time for matching is proportional to the square of this
number."""
N_COARSE = 256
"""Number of a picture's largest features that are used to find out whether two pictures share anything."""
N_PARTNERS = 16
N_NEIGHBOURS = 3
MAX_RATIO = 0.8
_ROWS_AT_ONCE = 1024


@dataclass(frozen=True)
class Features:
    """The features of one picture, the largest first."""

    points: np.ndarray
    """[n, 2] float64, pixels, rounded to float32, as COLMAP keeps them."""
    sift: np.ndarray
    """[n, 128] uint8: SIFT descriptors, in a quarter of the memory of `descriptors`."""

    @property
    def descriptors(self) -> np.ndarray:
        """RootSIFT descriptors, [n, 128] float32 of unit length (Arandjelovic and Zisserman, CVPR 2012)."""
        found = self.sift.astype(np.float32)
        return np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1e-6))


def find_features(rgba: np.ndarray) -> Features:
    """Return the features of a picture, at most `MAX_FEATURES`, none where the picture is transparent.

    `rgba`: [height, width, 4] uint8. Raises MissingExtraError without OpenCV.
    """
    cv2 = opencv("features: expected OpenCV to find them")
    height, width = rgba.shape[:2]
    grey = shrunk(cv2, cv2.cvtColor(rgba, cv2.COLOR_RGBA2GRAY), MAX_SIDE)
    mask = shrunk(cv2, rgba[..., 3], MAX_SIDE, cv2.INTER_NEAREST)
    # Half of OpenCV's contrast threshold: dim and smooth things need features too, and the limit on their
    # number keeps the strongest.
    sift = cv2.SIFT.create(nfeatures=MAX_FEATURES, contrastThreshold=0.02, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(grey, mask)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    order = np.argsort([-keypoint.size for keypoint in keypoints], kind="stable")[:MAX_FEATURES]
    points = np.array([keypoint.pt for keypoint in keypoints], np.float64)[order]
    # OpenCV has the centre of the first pixel at (0, 0), this project at (0.5, 0.5).
    points = (points + 0.5) * [width / grey.shape[1], height / grey.shape[0]]
    return Features(points.astype(np.float32).astype(np.float64), descriptors[order].astype(np.uint8))


def match(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the pairs of descriptors that are each other's nearest, and clearly nearer than the second
    nearest.

    `a` [n, 128], `b` [m, 128] of unit length. Returns [n_matches, 2] uint32, indices into `a` and `b`.

    >>> axes = np.eye(128, dtype=np.float32)
    >>> match(axes[:3], axes[[5, 2, 1]]).tolist()
    [[1, 2], [2, 1]]
    """
    if len(a) == 0 or len(b) < 2:
        return np.zeros((0, 2), np.uint32)
    nearest = np.empty(len(a), np.intp)
    best, second = np.empty(len(a), np.float32), np.empty(len(a), np.float32)
    best_of_b = np.full(len(b), -np.inf, np.float32)
    # In blocks, to save memory. Not in smaller ones, because BLAS wakes its threads for each block.
    for start in range(0, len(a), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        cosines = a[rows] @ b.T
        index = np.arange(len(cosines))
        np.maximum(best_of_b, cosines.max(axis=0), out=best_of_b)
        nearest[rows] = cosines.argmax(axis=1)
        best[rows] = cosines[index, nearest[rows]]
        cosines[index, nearest[rows]] = -np.inf
        second[rows] = cosines.max(axis=1)
    # Squared distances of unit vectors are 2 - 2 cos.
    distinct = (1 - best) < MAX_RATIO**2 * (1 - second)
    kept = np.flatnonzero(distinct & (best >= best_of_b[nearest]))
    return np.stack([kept, nearest[kept]], axis=-1).astype(np.uint32)


def pairs_to_match(features: Sequence[Features], progress: Progress) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of pictures that are worth matching.

    Each picture is paired with the `N_PARTNERS` that share most of its largest features (preemptive matching:
    Wu, Towards linear-time incremental structure from motion, 3DV 2013). This finds where a walk comes back
    to its beginning, and what pictures in no order have in common. Each picture is also paired with its
    neighbours in the sequence, which in a video overlap even where no large features are seen. `progress`:
    called with the number of pairs that have been compared, and of all; the time grows with their number, and
    so with the square of the number of pictures.
    """
    n = len(features)
    coarse = np.zeros((n, N_COARSE, 128), np.float32)
    for picture, rows in zip(features, coarse, strict=True):
        largest = Features(picture.points[:N_COARSE], picture.sift[:N_COARSE]).descriptors
        rows[: len(largest)] = largest
    shared = np.zeros((n, n), np.int64)
    for i in range(n - 1):
        shared[i, i + 1 :] = _n_matches(coarse[i], coarse[i + 1 :])
        progress((i + 1) * (2 * n - i - 2) // 2, n * (n - 1) // 2)
    shared += shared.T
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= N_NEIGHBOURS
    chosen = near.copy()
    for i in range(n):
        partners = np.argsort(-np.where(np.arange(n) == i, -1, shared[i]), kind="stable")[:N_PARTNERS]
        chosen[i, partners] = True
    chosen |= chosen.T
    return [(int(i), int(j)) for i, j in np.argwhere(np.triu(chosen, 1))]


def _n_matches(a: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Count the matches [n_others] that `match` would find between `a` [n, 128] and each of `others`
    [n_others, m, 128]; rows of zeros match nothing."""
    cosines = (a @ others.reshape(-1, 128).T).reshape(len(a), *others.shape[:2])
    best_of_others = cosines.max(axis=0)
    nearest = cosines.argmax(axis=2)
    best = cosines.max(axis=2)
    np.put_along_axis(cosines, nearest[..., None], -np.inf, axis=2)
    distinct = (1 - best) < MAX_RATIO**2 * (1 - cosines.max(axis=2))
    mutual = best >= best_of_others[np.arange(len(others)), nearest]
    return (distinct & mutual).sum(axis=0)
