"""The world of a capture: which way is up, and how long a unit is.

Pictures alone tell neither. But people hold cameras level, so that the x axes (the right-hand directions) of
upright pictures lie in the horizontal plane. And where people photograph something on a table, a floor or the
ground, that surface is the largest level plane in the scene, and nothing lies below it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from player.cameras.camera import Camera
from player.errors import DataError
from vfr_bake.data.store.capture import Capture, PosedImages

SIDEWAYS = 0.1
"""Sine of the angle by which the x axis of a camera that is held level may leave the horizontal plane. The x
axes of pictures that lie on their side leave it by far more, and get hardly any weight."""
N_ROUNDS = 20
MAX_TILT = 5.0
"""Largest angle, in degrees, between the up direction of the cameras and the normal of a plane that counts as
level ground. The x axes of cameras are off by one or two degrees, and a plane that leans by more than this is
a slope."""
N_TRIALS = 1000
MIN_SHARE, MAX_BELOW = 0.2, 0.05
"""Shares of the points: at least MIN_SHARE must lie in the ground plane, and less than MAX_BELOW below it."""
THICKNESS = 0.01
"""Half the thickness of the ground plane, as a share of the median distance of the points from their
middle."""
MOST_POINTS = 5000
"""A sample of about this many points stands for all points of a scene."""


def find_up(c2w: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the up direction [3], of unit length, in the world of estimated cameras.

    `c2w`: [n_cameras, 4, 4], OpenGL axes, of upright pictures. `points`: [n_points, 3] of the scene. Up is at
    right angles to the x axes of most cameras. If there is a ground plane whose normal agrees with that to
    within `MAX_TILT`, up is its normal.

    >>> c2w = np.eye(4)[None].repeat(3, axis=0)
    >>> find_up(c2w, np.zeros((0, 3))).tolist()
    [0.0, 1.0, 0.0]
    """
    up = _up_of_cameras(c2w)
    normal = _ground(points, up)
    return up if normal is None else normal


def _up_of_cameras(c2w: np.ndarray) -> np.ndarray:
    """Return the unit vector up that minimises the sum of w_i (r_i up)^2, where r_i are the cameras' x axes.
    The weights w_i leave out cameras that lie on their side (iteratively reweighted least squares, Geman and
    McClure's weights)."""
    rights, ups = c2w[:, :3, 0], c2w[:, :3, 1]
    up = _unit(np.median(ups, axis=0), ups[0])
    for _ in range(N_ROUNDS):
        weights = 1 / (1 + (rights @ up / SIDEWAYS) ** 2) ** 2
        mean = _unit(weights @ ups, up)
        spread = (rights * weights[:, None]).T @ rights / weights.sum()
        # A prior of weight 1e-3 pulls up towards the mean of the cameras' own up axes, because the x axes
        # alone may not determine it. It is as strong as x axes that turn by two degrees.
        up = _unit(np.linalg.solve(spread + 1e-3 * np.eye(3), 1e-3 * mean), mean)
    return up


def _ground(points: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """Return the upward normal [3] of the largest level plane with hardly anything below it, or None (RANSAC:
    Fischler and Bolles, 1981)."""
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
    """Return the normal [3], upward and of unit length, or None if its plane is not level."""
    length = np.linalg.norm(normal)
    cosine = float(normal @ up) / length if length > 0 else 0.0
    if abs(cosine) < np.cos(np.radians(MAX_TILT)):
        return None
    return normal * (np.sign(cosine) / length)


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else otherwise


def turn_to_z(up: np.ndarray) -> np.ndarray:
    """Return the smallest rotation [3, 3] that takes `up` [3], of unit length, to the z axis.

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


def scaled(
    capture: Capture, first: str, second: str, distance: float, why: Mapping[str, str] | None = None
) -> Capture:
    """Return the capture in a world in which two of its cameras are `distance` units apart.

    `first`, `second`: file names of the pictures that these cameras took. `distance`: more than 0. `why`: the
    reasons why further pictures have no camera, by their names. Raises DataError: there is no such picture,
    it has no camera, or both are from one place.
    """
    a, b = (_place(capture, name, why or {}) for name in (first, second))
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


def _place(capture: Capture, name: str, why: Mapping[str, str]) -> np.ndarray:
    """Return the position [3] of the camera of the picture called `name`."""
    cameras: list[Camera] = [*capture.train.cameras, *capture.test.cameras]
    found = named([camera.name for camera in cameras], name)
    if len(found) == 1:
        return cameras[found[0]].c2w[:3, 3]
    left_out = named([*why], name)
    if not found and len(left_out) == 1:
        raise DataError(
            f"{capture.name}: scale: {name}: expected a picture with a camera, got one without: "
            f"{[*why.values()][left_out[0]]}: name another one"
        )
    raise DataError(
        f"{capture.name}: scale: {name}: expected one picture with a camera, got "
        f"{len(found) or 'none'} of that name: the first is called {cameras[0].name}"
    )


def named(names: Sequence[str], name: str) -> list[int]:
    """Return the numbers of the pictures with these `names` that `name` means: it may lack the folder and the
    suffix.

    >>> named(["a/1.jpg", "b/1.jpg", "b/2.jpg"], "2"), named(["a/1.jpg", "b/1.jpg"], "1.jpg")
    ([2], [0, 1])
    """
    for form in (str, _last, _stem):
        found = [number for number, other in enumerate(names) if form(other) == form(name)]
        if found:
            return found
    return []


def _last(name: str) -> str:
    return name.rsplit("/", 1)[-1]


def _stem(name: str) -> str:
    return _last(name).rsplit(".", 1)[0]
