"""The world of a capture: which way is up, and how long a unit is.

Pictures alone tell neither. People hold cameras level, so that the right hands of pictures that are turned
upright lie in the horizontal plane; and where they photograph something on a table, a floor or the ground,
that is the largest level plane of what they see, and has nothing below it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from player.cameras.camera import Camera
from player.errors import DataError
from vfr_bake.data.capture import Capture, PosedImages

SIDEWAYS = 0.1
"""Sine of how far the right hand of a picture that is held level leaves the horizontal plane; those of
pictures that lie on their side leave it by far more, and hardly count."""
N_ROUNDS = 20
MAX_TILT = 5.0
"""Degrees between up as the cameras tell it and the normal of a ground that is taken to be level: hands are
off by one or two, and what leans by more is a slope."""
N_TRIALS = 1000
MIN_SHARE, MAX_BELOW = 0.2, 0.05
"""Shares of the points that lie in the ground, at least, and below it, at most."""
THICKNESS = 0.01
"""Half the thickness of the ground, as a share of the median distance of the points from their middle."""
MOST_POINTS = 5000
"""About so many points of a scene are enough to tell of all."""


def find_up(c2w: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Up [3] in the world of estimated cameras, of unit length.

    `c2w`: [n_cameras, 4, 4], OpenGL axes, of upright pictures. `points`: [n_points, 3] of the scene. Up is at
    right angles to the right hands of most cameras, and the normal of the ground where there is one that
    agrees to `MAX_TILT`.

    >>> c2w = np.eye(4)[None].repeat(3, axis=0)
    >>> find_up(c2w, np.zeros((0, 3))).tolist()
    [0.0, 1.0, 0.0]
    """
    up = _up_of_cameras(c2w)
    normal = _ground(points, up)
    return up if normal is None else normal


def _up_of_cameras(c2w: np.ndarray) -> np.ndarray:
    """Minimise the sum of w_i (r_i up)^2 over unit vectors, with right hands r_i, and weights w_i that leave
    out what lies on its side (iteratively reweighted least squares, Geman and McClure's weights)."""
    rights, ups = c2w[:, :3, 0], c2w[:, :3, 1]
    up = _unit(np.median(ups, axis=0), ups[0])
    for _ in range(N_ROUNDS):
        weights = 1 / (1 + (rights @ up / SIDEWAYS) ** 2) ** 2
        mean = _unit(weights @ ups, up)
        spread = (rights * weights[:, None]).T @ rights / weights.sum()
        # As much as right hands tell that turn by two degrees: alone they may not tell at all.
        up = _unit(np.linalg.solve(spread + 1e-3 * np.eye(3), 1e-3 * mean), mean)
    return up


def _ground(points: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """The upward normal [3] of the largest level plane with nothing below it, or None (RANSAC: Fischler and
    Bolles, 1981)."""
    if len(points) < 100:
        return None
    random = np.random.default_rng(0)
    if len(points) > MOST_POINTS:
        points = points[random.choice(len(points), MOST_POINTS, replace=False)]
    points = points - np.median(points, axis=0)
    thick = THICKNESS * float(np.median(np.linalg.norm(points, axis=1)))
    best, most = None, MIN_SHARE * len(points)
    for a, b, c in points[random.integers(len(points), size=(N_TRIALS, 3))]:
        normal = _level(np.cross(b - a, c - a), up)
        if normal is None:
            continue
        heights = (points - a) @ normal
        n_in = int((np.abs(heights) < thick).sum())
        if n_in > most and (heights < -3 * thick).mean() < MAX_BELOW:
            best, most = np.abs(heights) < thick, n_in
    if best is None:
        return None
    ground = points[best] - points[best].mean(axis=0)
    return _level(np.linalg.svd(ground, full_matrices=False)[2][2], up)


def _level(normal: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """The normal [3], upward and of unit length, if its plane is level."""
    length = np.linalg.norm(normal)
    cosine = float(normal @ up) / length if length > 0 else 0.0
    if abs(cosine) < np.cos(np.radians(MAX_TILT)):
        return None
    return normal * (np.sign(cosine) / length)


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else otherwise


def turn_to_z(up: np.ndarray) -> np.ndarray:
    """The smallest rotation [3, 3] that takes `up` [3], of unit length, to the z axis.

    >>> (turn_to_z(np.array([0.0, 1.0, 0.0])) @ [0, 1, 0]).round(6).tolist()
    [0.0, 0.0, 1.0]
    """
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    # Rodrigues' formula for the axis up x (0, 0, 1).
    return np.array(
        [[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z]]
    )


def scaled(capture: Capture, first: str, second: str, distance: float) -> Capture:
    """The capture in a world whose unit is that of `distance`, which lies between two of its cameras.

    `first`, `second`: the pictures that they took, by the names of their files. `distance`: more than 0.
    Raises DataError: no such picture, or two from one place.
    """
    a, b = (_place(capture, name) for name in (first, second))
    apart = float(np.linalg.norm(a - b))
    if apart <= 1e-9 * float(np.abs([a, b]).max()):
        raise DataError(
            f"{capture.name}: scale: expected two pictures from different places, got {first} and {second}"
        )
    factor = distance / apart

    def moved(views: PosedImages) -> PosedImages:
        cameras = []
        for camera in views.cameras:
            c2w = camera.c2w.copy()
            c2w[:3, 3] *= factor
            cameras.append(replace(camera, c2w=c2w))
        return replace(views, cameras=cameras)

    points = None if capture.points is None else capture.points * factor
    return replace(capture, train=moved(capture.train), test=moved(capture.test), points=points)


def _place(capture: Capture, name: str) -> np.ndarray:
    """Where the camera [3] of the picture called `name` is, with or without its folder and its ending."""
    cameras: list[Camera] = [*capture.train.cameras, *capture.test.cameras]
    for form in (_whole, _last, _stem):
        found = [camera for camera in cameras if form(camera.name) == form(name)]
        if len(found) == 1:
            return found[0].c2w[:3, 3]
        if len(found) > 1:
            break
    got = f"{len(found)} of that name" if found else "none of that name"
    raise DataError(
        f"{capture.name}: scale: {name}: expected one picture with a camera, got {got}: the first is called "
        f"{cameras[0].name}"
    )


def _whole(name: str) -> str:
    return name


def _last(name: str) -> str:
    return name.rsplit("/", 1)[-1]


def _stem(name: str) -> str:
    return _last(name).rsplit(".", 1)[0]
