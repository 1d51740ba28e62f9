"""Models that are folded, because the subject looks the same from two sides.

A can whose label is printed twice matches itself across the walk around it: a model built from all matches
takes opposite sides for one, and tears pictures that follow each other apart. The matches of the label agree
with one geometry, so that nothing in a single pair tells. The walk does: pictures that follow each other
nearly always show the same side, and a model of them alone says how far the cameras of all other pairs are
turned. Pairs whose own geometry says something else are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from vfr_bake.data.features import N_NEIGHBOURS, Features
from vfr_bake.data.mapping import Pair, n_threads, pycolmap_module

MIN_KEPT = 0.1
"""Of the matches of two pictures that follow each other, a model keeps more than half as points that both see
(fox and can: 0.52 to 0.97), and 0 to 0.02 where it is folded."""
MAX_TURN = 30.0
"""Degrees between what a pair's own geometry says of the turn and what the walk does. Walks drift, and two
views of a plane are off by some 10 degrees: of can's pairs that are a lap apart nine in ten are within it,
and those of opposite sides are off by 90 to 180."""


def torn_neighbours(model: Any, names: Sequence[str], pairs: Sequence[Pair]) -> list[tuple[int, int]]:
    """The pairs (i, i + 1) that match, but of whose matches a `pycolmap.Reconstruction` keeps next to none.

    `names`: of the pictures, in the order of their numbers.
    """
    points = {
        image.name: np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], np.int64)
        for image in model.images.values()
        if image.has_pose
    }
    torn = []
    for pair in pairs:
        i, j = names[pair.i], names[pair.j]
        if pair.j - pair.i == 1 and i in points and j in points:
            first, second = pair.geometry.inlier_matches.T
            a, b = points[i][first], points[j][second]
            if ((a == b) & (a >= 0)).mean() < MIN_KEPT:
                torn.append((pair.i, pair.j))
    return torn


def near_pairs(pairs: Sequence[Pair]) -> list[Pair]:
    """The pairs of pictures that (nearly) follow each other."""
    return [pair for pair in pairs if pair.j - pair.i <= N_NEIGHBOURS]


def agreeing_pairs(
    walk: Any,
    names: Sequence[str],
    features: Sequence[Features],
    pairs: Sequence[Pair],
    progress: Callable[[int, int], object],
) -> list[Pair]:
    """The near pairs, and those of the others whose turn is the one that `walk`, the model of the near ones,
    has: where it comes by again."""
    pycolmap = pycolmap_module()
    images: dict[str, Any] = {image.name: image for image in walk.images.values() if image.has_pose}
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    options.compute_relative_pose = True

    def agrees(pair: Pair) -> bool:
        if pair.j - pair.i <= N_NEIGHBOURS:
            return True
        if names[pair.i] not in images or names[pair.j] not in images:
            return False
        ends = [images[names[number]] for number in (pair.i, pair.j)]
        cameras = [walk.camera(image.camera_id) for image in ends]
        own = pycolmap.estimate_calibrated_two_view_geometry(
            cameras[0], features[pair.i].points, cameras[1], features[pair.j].points,
            pair.geometry.inlier_matches, options,
        )  # fmt: skip
        if own.cam2_from_cam1 is None:
            return False
        first, second = (image.cam_from_world().rotation.matrix() for image in ends)
        cosine = (np.trace(own.cam2_from_cam1.rotation.matrix() @ first @ second.T) - 1) / 2
        return bool(cosine > np.cos(np.radians(MAX_TURN)))

    agreeing = []
    with ThreadPoolExecutor(n_threads()) as pool:
        futures = [pool.submit(agrees, pair) for pair in pairs]
        try:
            for done, (pair, future) in enumerate(zip(pairs, futures, strict=True)):
                if future.result():
                    agreeing.append(pair)
                progress(done + 1, len(pairs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return agreeing
