"""Views between the training cameras: what the bake learns from and is measured on without a data set."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from player.cameras.camera import Camera, focus_point
from player.cameras.keyframes import smooth_path
from vfr_bake.training.model_file import Model

LARGEST_TURN = np.deg2rad(15.0)
"""Farther from a training camera than this nobody has taught the model anything."""
BETWEEN = 4
"""Views between for each training camera, where the number of rays does not depend on that of the views."""
NEIGHBOURS = 3
"""Training cameras that count as beside one: on a walk the next, the last and one more."""
PLACES = 64
"""On the way between two cameras, one of which is taken."""
MARGIN = 0.1
"""Of a picture of an unbounded scene, on every side: what the bake looks at beyond its border. Fox's held-out
views see there, and what was not stored cost them a decibel and more."""
ASIDE = 1.0
"""Of the way between two cameras: up to so far aside of it stand views of an unbounded scene. A held-out view
of can, which stands that far from the others, lost 5 dB to cells that came into sight and were not stored."""


def views_between(model: Model, n_views: int, seed: int, wide: bool = False) -> list[Camera]:
    """`n_views` cameras (model frame), each between a training camera, of which all have their turn, and one
    of its nearest: a quarter to half of the way there, and turned around what all cameras look at by up to a
    quarter of the angle between the two. `wide` ones also stand aside of that way and see beyond their
    borders (`widened`). The same seed gives the same views, another one others."""
    cameras = model.model_cameras()
    random = np.random.default_rng(seed)
    focus = focus_point(cameras)
    places = np.stack([camera.c2w[:3, 3] for camera in cameras])
    sides = (places - focus) / np.maximum(np.linalg.norm(places - focus, axis=1, keepdims=True), 1e-9)
    first = random.integers(0, len(cameras))
    chosen = (first + np.linspace(0, len(cameras), n_views, endpoint=False).astype(int)) % len(cameras)
    found = []
    for index in chosen:
        nearest = np.argsort(np.linalg.norm(places - places[index], axis=1))[1 : NEIGHBOURS + 1]
        other = random.choice(nearest) if len(nearest) else index
        angle = float(np.arccos(np.clip(sides[index] @ sides[other], -1, 1)))
        share = min(random.uniform(0.25, 0.5), LARGEST_TURN / max(angle, 1e-9))
        path = smooth_path([cameras[index], cameras[other]], PLACES)
        axis = random.normal(size=3)
        turn = _turn(axis / np.linalg.norm(axis), min(angle, LARGEST_TURN) / 4 * random.uniform(0.5, 1))
        move = np.eye(4)
        move[:3, :3] = turn
        move[:3, 3] = focus - turn @ focus
        camera = path[round(share * PLACES)]
        if wide:
            aside = random.normal(size=3)
            aside *= random.uniform(0, ASIDE) / np.linalg.norm(aside)
            move[:3, 3] += aside * np.linalg.norm(places[other] - places[index])
        found.append(replace(camera, name=f"{camera.name} turned", c2w=move @ camera.c2w))
    return [widened(camera) for camera in found] if wide else found


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """[3, 3] rotation by `angle` around the unit `axis` (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def widened(camera: Camera) -> Camera:
    """The camera with a border of MARGIN of its picture on every side.

    >>> wide = widened(Camera("a", np.eye(4), 100, 50, 80.0, 80.0, 50.0, 25.0))
    >>> wide.width, wide.height, wide.cx, wide.cy
    (120, 60, 60.0, 30.0)
    """
    x, y = round(MARGIN * camera.width), round(MARGIN * camera.height)
    size = {"width": camera.width + 2 * x, "height": camera.height + 2 * y}
    return replace(camera, **size, cx=camera.cx + x, cy=camera.cy + y)
