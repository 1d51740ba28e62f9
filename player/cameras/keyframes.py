"""A smooth camera path through a few views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from player.cameras.camera import Camera
from player.cameras.rotations import quaternion, rotation_matrix


def smooth_path(views: Sequence[Camera], n_between: int) -> list[Camera]:
    """Return cameras on a path through `views`: `n_between` steps from each view to the next, the last view
    included.

    Positions lie on a Catmull-Rom spline, rotations turn evenly from view to view (slerp), and the focal
    length changes by equal factors. Size and name are those of the first view. The vertical field of view is
    that of each view, whatever the view's size.

    >>> views = [Camera(str(x), np.eye(4), 4, 4, f, f, 2.0, 2.0) for x, f in enumerate((5.0, 20.0))]
    >>> [round(camera.fx, 6) for camera in smooth_path(views, 2)]
    [5.0, 10.0, 20.0]
    """
    path = [
        camera_on_path(views, index, step / n_between)
        for index in range(len(views) - 1)
        for step in range(n_between)
    ]
    return [*path, _zoomed(views[0], views[-1].c2w, _focal(views[0], views[-1]))]


def camera_on_path(views: Sequence[Camera], index: int, share: float) -> Camera:
    """Return one camera of `smooth_path`: at `share`, 0 to 1, of the way from `views[index]` to the next
    view.

    >>> views = [Camera(str(x), np.eye(4), 4, 4, f, f, 2.0, 2.0) for x, f in enumerate((5.0, 20.0))]
    >>> round(camera_on_path(views, 0, 0.5).fx, 6)
    10.0
    """
    around = [views[i].c2w[:3, 3] for i in np.clip(np.arange(index - 1, index + 3), 0, len(views) - 1)]
    one, other = views[index], views[index + 1]
    a, b = quaternion(one.c2w[:3, :3]), quaternion(other.c2w[:3, :3])
    c2w = np.eye(4)
    c2w[:3, :3] = rotation_matrix(_slerp(a, -b if a @ b < 0 else b, share))  # turn the short way
    c2w[:3, 3] = _spline(around, share)
    fy = _focal(views[0], one) ** (1 - share) * _focal(views[0], other) ** share
    return _zoomed(views[0], c2w, fy)


def _focal(size: Camera, view: Camera) -> float:
    """Return `fy` of a picture as high as that of `size` with the vertical field of view of `view`."""
    return view.fy / view.height * size.height


def _zoomed(camera: Camera, c2w: np.ndarray, fy: float) -> Camera:
    return replace(camera, c2w=c2w, fx=camera.fx * fy / camera.fy, fy=fy)


def _spline(points: Sequence[np.ndarray], share: float) -> np.ndarray:
    """Return the point of a Catmull-Rom spline between the second and the third of four points."""
    a, b, c, d = points
    linear, square, cube = c - a, 2 * a - 5 * b + 4 * c - d, 3 * b - 3 * c + d - a
    return b + share / 2 * (linear + share * (square + share * cube))


def _slerp(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    angle = np.arccos(np.clip(a @ b, -1, 1))
    if angle < 1e-6:
        mixed = (1 - share) * a + share * b
    else:
        mixed = (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)
    return mixed / np.linalg.norm(mixed)
