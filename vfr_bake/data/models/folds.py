"""Find models that are folded, because the subject looks the same from two sides, and the pairs that unfold
them.

A can whose label is printed twice matches itself across the walk around it. A model built from all matches
takes opposite sides for one, and tears apart pictures that follow each other. The matches of the label agree
with one geometry, so that a single pair does not reveal the mistake. The walk does: pictures that follow each
other nearly always show the same side, and a model of them alone says how far the cameras of every other pair
are turned. Pairs whose own geometry says something else are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from player.cameras.camera import Camera
from player.cameras.rotations import OPENGL_FROM_OPENCV
from player.progress import Progress
from vfr_bake.data.features import N_NEIGHBOURS, Features, find_features, match
from vfr_bake.data.mapping import MIN_MATCHES, Pair, pycolmap_module, two_view_options
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.threads import in_threads

MIN_KEPT = 0.1
"""Share of the matches of two pictures that follow each other which a model must keep as points that both
see. It keeps more than half (fox and can: 0.52 to 0.97), and 0 to 0.02 where it is folded."""
MAX_TURN = 30.0
"""Largest difference, in degrees, between the turn by a pair's own geometry and the turn by the walk. Walks
drift, and two views of a plane are off by some 10 degrees: of can's pairs that are a lap apart nine in ten
are within the limit, and those of opposite sides are off by 90 to 180."""
WALK_TURN, LEAP_TURN = 20.0, 60.0
"""Degrees. Pictures are a walk if half of them turn by no more than WALK_TURN from one to the next. They leap
where one turns by more than LEAP_TURN."""


def torn_neighbours(model: Any, names: Sequence[str], pairs: Sequence[Pair]) -> list[tuple[int, int]]:
    """Return the pairs (i, i + 1) that match, but of whose matches a `pycolmap.Reconstruction` keeps next to
    none.

    `names`: names of the pictures, in the order of their numbers.
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


def is_near(pair: Pair) -> bool:
    """Return whether the pictures of a pair (nearly) follow each other."""
    return pair.j - pair.i <= N_NEIGHBOURS


def agreeing_pairs(
    walk: Any,
    names: Sequence[str],
    features: Sequence[Features],
    pairs: Sequence[Pair],
    progress: Progress,
) -> list[Pair]:
    """Return the near pairs, and those other pairs whose own turn agrees with that in `walk`, the model of
    the near pairs: they connect the places that the walk comes by again."""
    images: dict[str, Any] = {image.name: image for image in walk.images.values() if image.has_pose}

    def agrees(pair: Pair) -> bool:
        if is_near(pair):
            return True
        if names[pair.i] not in images or names[pair.j] not in images:
            return False
        ends = [images[names[number]] for number in (pair.i, pair.j)]
        cameras = [walk.camera(image.camera_id) for image in ends]
        points = (features[pair.i].points, features[pair.j].points)
        own = _own_turn(cameras, points, pair.geometry.inlier_matches)
        first, second = (image.cam_from_world().rotation.matrix() for image in ends)
        return own is not None and _angle(own @ first @ second.T) < MAX_TURN

    agreeing = in_threads(agrees, pairs, progress)
    return [pair for pair, agreed in zip(pairs, agreeing, strict=True) if agreed]


def torn_views(views: PosedImages) -> list[tuple[str, str]]:
    """Return the names of neighbours in a walk whose given cameras leap apart, although their matches say
    that they do not.

    This is a hint that the cameras were estimated elsewhere and are folded. OpenCV and pycolmap are needed
    only if cameras leap. Raises MissingExtraError.
    """
    opencv_from_opengl = OPENGL_FROM_OPENCV[:3, :3].T
    rotations = [opencv_from_opengl @ camera.c2w[:3, :3].T for camera in views.cameras]
    turns = [after @ before.T for before, after in pairwise(rotations)]
    angles = np.array([_angle(turn) for turn in turns])
    if len(angles) == 0 or np.median(angles) > WALK_TURN:
        return []
    torn = []
    for i in np.flatnonzero(angles > LEAP_TURN):
        ends = views.cameras[i : i + 2]
        found = [find_features(image) for image in views.images[int(i) : int(i) + 2]]
        matches = match(found[0].descriptors, found[1].descriptors)
        if len(matches) < MIN_MATCHES:
            continue
        own = _own_turn([_pinhole(camera) for camera in ends], [each.points for each in found], matches)
        if own is not None and _angle(own) < LEAP_TURN and _angle(own @ turns[i].T) > MAX_TURN:
            torn.append((ends[0].name, ends[1].name))
    return torn


def _pinhole(camera: Camera) -> Any:
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    return pycolmap_module().Camera(model="PINHOLE", width=camera.width, height=camera.height, params=params)


def _own_turn(cameras: Sequence[Any], points: Sequence[np.ndarray], matches: np.ndarray) -> np.ndarray | None:
    """Return the rotation [3, 3] from the first to the second of two `pycolmap.Camera`s with which most
    matches of their `points` agree; None if too few agree with any."""
    options = two_view_options()
    options.compute_relative_pose = True
    own = pycolmap_module().estimate_calibrated_two_view_geometry(
        cameras[0], points[0], cameras[1], points[1], matches, options
    )
    if own.cam2_from_cam1 is None or len(own.inlier_matches) < MIN_MATCHES:
        return None
    return own.cam2_from_cam1.rotation.matrix()


def _angle(rotation: np.ndarray) -> float:
    """Return the angle of a rotation [3, 3] in degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))
