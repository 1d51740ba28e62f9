"""Posed pictures of one scene, in the frame that everything after the data set works in.

The model frame puts an object's cubic box at [-1, 1]³ and the cameras of an unbounded scene into the unit
ball around what they look at, whatever the scene's unit; `world_from_model` undoes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from player.cameras.camera import Camera, focus_point
from player.errors import DataError
from vfr_bake.config import SceneKind
from vfr_bake.data.bounds import scene_box
from vfr_bake.data.capture import Capture, PosedImages
from vfr_bake.data.files.masks import check_masked
from vfr_bake.data.world import MOST_POINTS

BORDER = 2
"""Pixels along a picture's edge that tell a plain background."""
PLAIN_SHARE, PLAIN_LEVELS = 0.95, 8
"""A background is plain if so large a share of the border pixels is within so many levels of one colour."""
N_LOOKED_AT = 200
"""Silhouettes and borders are looked at in so many of the pictures, spread evenly."""
CAMERA_QUANTILE = 0.9
"""This share of an unbounded scene's cameras lies in the unit ball: one that strayed must not shrink the
rest."""
NEAR_CAMERA = 0.05
"""Matter begins at this distance from a camera, model units, where no points tell: nearer things than a
twentieth of the way to the subject are out of focus in a photograph."""
NEAR_QUANTILE, NEAR_SHARE = 0.01, 0.5
"""Where points tell: matter begins at half the depth that one point in a hundred is in front of."""


@dataclass(frozen=True)
class Scene:
    """A scene to train on and to test with."""

    name: str
    train: PosedImages
    test: PosedImages
    """Views that training never sees; none when there are too few to spare one."""
    has_alpha: bool
    """Whether any training picture has a pixel that is not opaque and not masked either."""
    world_from_model: np.ndarray
    """[4, 4] float64: uniform scale and translation."""
    unbounded: bool = False
    """Whether the pictures show surroundings without end, or an object in a box."""
    near: float = 0.0
    """Unbounded: how near to a camera matter may begin, model units."""
    masked: bool = False
    """Whether pixels that are not opaque are masked: they are neither drawn nor scored."""


def build_scene(capture: Capture, kind: SceneKind = "auto") -> Scene:
    """A `Scene` out of pictures with cameras in the world: finds its kind and moves the cameras to the model
    frame, which the training views alone decide.

    Raises DataError where depth is not to be had: fewer than two training views, or all from one place.

    >>> from vfr_bake.data.demo import demo_capture
    >>> scene = build_scene(demo_capture(size=16, n_train=4, n_test=1))
    >>> scene.has_alpha, scene.unbounded, scene.train.images[0].shape
    (True, False, (16, 16, 4))
    """
    train, test = capture.train, capture.test
    _check_cameras(capture.name, train.cameras)
    has_alpha = not capture.masked and not all(train.opaque(number) for number in range(len(train.cameras)))
    some = _spread(train)
    unbounded = kind == "unbounded" or (kind == "auto" and not has_alpha and not _plain_border(some))
    if unbounded:
        centre, half = _camera_ball(train.cameras)
    else:
        centre, half = scene_box(
            *(some.cameras, [image[..., 3] for image in some.images]) if has_alpha else (train.cameras, None)
        )
    world_from_model = np.eye(4)
    world_from_model[:3, :3] *= half
    world_from_model[:3, 3] = centre
    near = _near(train.cameras, capture.points, half) if unbounded else 0.0
    model_from_world = np.linalg.inv(world_from_model)

    def moved(views: PosedImages) -> PosedImages:
        return PosedImages([camera.transformed(model_from_world) for camera in views.cameras], views.images)

    # Nothing is empty in front of surroundings without end: what is transparent there has been masked.
    masked = capture.masked or (unbounded and has_alpha)
    has_alpha = has_alpha and not masked
    if masked:
        check_masked(capture.name, train.images)
    return Scene(
        capture.name, moved(train), moved(test), has_alpha, world_from_model, unbounded, near, masked
    )


def _check_cameras(name: str, cameras: list[Camera]) -> None:
    if len(cameras) < 2:
        raise DataError(f"{name}: training views: expected at least 2, got {len(cameras)}")
    places = np.stack([camera.c2w[:3, 3] for camera in cameras])
    spread = float(np.abs(places - places[0]).max())
    if spread <= 1e-6 * float(np.abs(places).max()) or spread == 0:
        raise DataError(
            f"{name}: training views: all {len(cameras)} are taken from one place, which tells no depth: "
            "move around the subject"
        )


def _spread(views: PosedImages) -> PosedImages:
    """At most N_LOOKED_AT of the views, spread evenly."""
    n_views = len(views.cameras)
    return views.some(
        set(np.linspace(0, n_views - 1, min(n_views, N_LOOKED_AT)).round().astype(int).tolist())
    )


def _plain_border(views: PosedImages) -> bool:
    """Whether the pictures' edges show nothing but one colour."""
    edges = [
        views.pixels(number, _border(camera.width, camera.height))[:, :3]
        for number, camera in enumerate(views.cameras)
    ]
    pixels = np.concatenate(edges).astype(np.int16)
    off = np.abs(pixels - np.median(pixels, axis=0)).max(axis=1)
    return float((off <= PLAIN_LEVELS).mean()) >= PLAIN_SHARE


def _border(width: int, height: int) -> np.ndarray:
    """[n] the numbers of a picture's pixels along its four edges; those of its corners come twice."""
    numbers = np.arange(width * height).reshape(height, width)
    edges = (numbers[:BORDER], numbers[-BORDER:], numbers[:, :BORDER], numbers[:, -BORDER:])
    return np.concatenate([edge.reshape(-1) for edge in edges])


def _camera_ball(cameras: list[Camera]) -> tuple[np.ndarray, float]:
    """Centre [3] and radius of the ball around what the cameras look at that holds (nearly all of) them."""
    places = np.stack([camera.c2w[:3, 3] for camera in cameras])
    middle = places.mean(axis=0)
    spread = float(np.linalg.norm(places - middle, axis=1).max())
    centre = focus_point(cameras)
    if np.linalg.norm(centre - middle) > 20 * spread:
        centre = middle  # nearly parallel views meet nowhere in particular
    return centre, float(np.quantile(np.linalg.norm(places - centre, axis=1), CAMERA_QUANTILE))


def _near(cameras: list[Camera], points: np.ndarray | None, unit: float) -> float:
    """How near to a camera matter may begin, in units of `unit`."""
    if points is None or len(points) == 0:
        return NEAR_CAMERA
    points = points[:: max(1, len(points) // MOST_POINTS)]
    depths = np.concatenate([(camera.c2w[:3, 3] - points) @ camera.c2w[:3, 2] for camera in cameras])
    ahead = depths[depths > 0]
    if len(ahead) == 0:
        return NEAR_CAMERA
    return min(NEAR_CAMERA * 4, NEAR_SHARE * float(np.quantile(ahead, NEAR_QUANTILE)) / unit)
