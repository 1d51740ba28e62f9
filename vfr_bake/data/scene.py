"""Posed pictures of one scene, in the model frame, in which everything after the loading of the data set
works.

The model frame has an object's cubic box at [-1, 1]³, or the cameras of an unbounded scene in the unit ball
around what they look at, whatever the scene's unit is. `world_from_model` maps it back to the world.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from player.cameras.camera import Camera, focus_point
from player.errors import DataError
from vfr_bake.config import SceneKind
from vfr_bake.data.bounds import scene_box
from vfr_bake.data.files.masks import check_masked
from vfr_bake.data.store.capture import Capture, PosedImages
from vfr_bake.data.world import MOST_POINTS

BORDER = 2
"""Width in pixels of the border of a picture that is examined for a plain background."""
PLAIN_SHARE, PLAIN_LEVELS = 0.95, 8
"""A background is plain if at least PLAIN_SHARE of the opaque border pixels are within PLAIN_LEVELS of one
colour."""
DARK = 16
"""A colour whose levels are no higher than this, half a percent of white's light, does not tell of an object
unless the border pixels have exactly this colour, as in rendered pictures: the dark parts of photographs are
within a few levels of black, whatever is there."""
N_LOOKED_AT = 200
"""Number of pictures, spread evenly, whose silhouettes and borders are examined."""
CAMERA_QUANTILE = 0.9
"""Share of an unbounded scene's cameras that lie in the unit ball: one that strayed must not shrink the
rest."""
STRAYED = 3.0
"""One of a few cameras has strayed if it is this many times as far from the centre as any other."""
NEAR_CAMERA = 0.05
"""Distance from a camera, in model units, at which matter begins if no points are known. Things nearer than a
twentieth of the way to the subject are out of focus in a photograph."""
NEAR_QUANTILE, NEAR_SHARE = 0.01, 0.5
"""If points are known, matter begins at NEAR_SHARE of the depth that one point in a hundred (NEAR_QUANTILE)
is in front of, but at no more than 4 NEAR_CAMERA."""

WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Scene:
    """The views of a scene to train on and to test with."""

    name: str
    train: PosedImages
    test: PosedImages
    """Views that training never sees; empty if there are too few to spare one."""
    has_alpha: bool
    """Whether any training picture has a pixel that is neither opaque nor masked."""
    world_from_model: np.ndarray
    """[4, 4] float64: uniform scale and translation."""
    unbounded: bool = False
    """True if the pictures show surroundings without end, False if they show an object in a box."""
    near: float = 0.0
    """In an unbounded scene, the distance from a camera at which matter may begin, in model units."""
    masked: bool = False
    """Whether pixels that are not opaque are masked. Training does not draw them, and they are not scored."""
    background: tuple[float, float, float] = WHITE
    """What is behind an object, sRGB in [0, 1]: the colour of the pictures' borders if they are opaque and
    plain, else white."""


def build_scene(
    capture: Capture, kind: SceneKind = "auto", say: Callable[[str], object] = lambda text: None
) -> Scene:
    """Build a `Scene` from pictures with cameras in the world: find its kind, and move the cameras to the
    model frame, which the training views alone decide. `say`: called with a sentence if some pictures have
    transparent pixels that are masked, or if those of an object show what is around it.

    Raises DataError if depth cannot be found (fewer than two training views, or all from one place), if
    nearly everything is masked, if all pictures are transparent, or if pictures of an object with transparent
    surroundings have masks.

    >>> from vfr_bake.data.demo import demo_capture
    >>> scene = build_scene(demo_capture(size=16, n_train=4, n_test=1))
    >>> scene.has_alpha, scene.unbounded, scene.train.images[0].shape
    (True, False, (16, 16, 4))
    """
    train, test = capture.train, capture.test
    _check_cameras(capture.name, train.cameras)
    if capture.transparent and kind != "unbounded":
        raise DataError(
            f"{capture.name}: training views: expected transparent surroundings or masks, got both: remove "
            "the masks to train an object, or pass --kind unbounded, which masks what is transparent, too"
        )
    n_views = len(train.cameras)
    n_transparent = 0 if capture.masked else sum(not train.opaque(number) for number in range(n_views))
    has_alpha = n_transparent > 0
    some = _spread(train)
    if has_alpha and kind != "unbounded" and not any(image[..., 3].any() for image in train.images):
        raise DataError(
            f"{capture.name}: training views: expected something to be seen, got pictures that are "
            "transparent everywhere: save them with their colours, or without transparency"
        )
    # An object is transparent around it in all its pictures; a few holes say nothing of the others.
    mostly_opaque = 2 * n_transparent < n_views
    plain = _plain_border(some, exact_if_dark=kind == "auto") if mostly_opaque else None
    unbounded = kind == "unbounded" or (kind == "auto" and mostly_opaque and plain is None)
    if unbounded:
        centre, half = _camera_ball(train.cameras)
    else:
        # The comparison makes a new array, so that no picture stays in memory for its silhouette.
        silhouettes = [image[..., 3] > 0 for image in some.images] if has_alpha else None
        centre, half = scene_box(some.cameras if has_alpha else train.cameras, silhouettes)
    world_from_model = np.eye(4)
    world_from_model[:3, :3] *= half
    world_from_model[:3, 3] = centre
    near = _near(train.cameras, capture.points, half) if unbounded else 0.0
    model_from_world = np.linalg.inv(world_from_model)

    def moved(views: PosedImages) -> PosedImages:
        return PosedImages([camera.transformed(model_from_world) for camera in views.cameras], views.images)

    # In an unbounded scene every ray meets something, so that pixels can only be transparent because they
    # have been masked.
    masked = capture.masked or (unbounded and has_alpha)
    has_alpha = has_alpha and not masked
    if masked:
        check_masked(capture.name, train.images)
    if kind == "auto" and masked and not capture.masked:
        say(
            "less than half of the pictures have transparent pixels: these are masked, and the scene is "
            "unbounded (--kind object for an object)"
        )
    if kind == "object" and mostly_opaque and plain is None and not masked:
        say(
            "the pictures show more than the object, which is trained in front of white: make them "
            "transparent around it (--kind unbounded for all that they show)"
        )
    return Scene(
        capture.name,
        moved(train),
        moved(test),
        has_alpha,
        world_from_model,
        unbounded,
        near,
        masked,
        background=WHITE if unbounded or has_alpha or plain is None else plain,
    )


def _check_cameras(name: str, cameras: list[Camera]) -> None:
    if len(cameras) < 2:
        raise DataError(f"{name}: training views: expected at least 2, got {len(cameras)}")
    places = np.stack([camera.c2w[:3, 3] for camera in cameras])
    spread = float(np.abs(places - places[0]).max())
    if spread <= 1e-9 * float(np.abs(places).max()) or spread == 0:
        raise DataError(
            f"{name}: training views: all {len(cameras)} are taken from one place, which tells no depth: "
            "move around the subject"
        )


def _spread(views: PosedImages) -> PosedImages:
    """Return at most N_LOOKED_AT of the views, spread evenly."""
    return views.some(evenly(len(views.cameras), N_LOOKED_AT).tolist())


def evenly(n_views: int, n_chosen: int) -> np.ndarray:
    """Return the numbers of `n_chosen` of the views, spread evenly, or of all if there are no more.

    >>> evenly(10, 4).tolist(), evenly(2, 4).tolist()
    ([0, 3, 6, 9], [0, 1])
    """
    return np.linspace(0, n_views - 1, min(n_chosen, n_views)).round().astype(int)


def _plain_border(views: PosedImages, exact_if_dark: bool) -> tuple[float, float, float] | None:
    """Return the colour of the pictures' borders where these are opaque, sRGB in [0, 1]; None if they show
    more than one colour, or if less than half of them is opaque. `exact_if_dark`: whether the pixels of a
    DARK border have to be exactly equal."""
    edges = [
        views.pixels(number, _border(camera.width, camera.height))
        for number, camera in enumerate(views.cameras)
    ]
    rgba = np.concatenate(edges)
    pixels = rgba[rgba[:, 3] == 255, :3].astype(np.int16)
    if 2 * len(pixels) < len(rgba):
        return None
    colour = np.median(pixels, axis=0).round()
    levels = 0 if exact_if_dark and colour.max() <= DARK else PLAIN_LEVELS
    if (np.abs(pixels - colour).max(axis=1) <= levels).mean() < PLAIN_SHARE:
        return None
    red, green, blue = (colour / 255).tolist()
    return red, green, blue


def _border(width: int, height: int) -> np.ndarray:
    """Return the numbers [n] of the pixels along a picture's four edges; those of its corners come twice."""
    numbers = np.arange(width * height).reshape(height, width)
    edges = (numbers[:BORDER], numbers[-BORDER:], numbers[:, :BORDER], numbers[:, -BORDER:])
    return np.concatenate([edge.reshape(-1) for edge in edges])


def _camera_ball(cameras: list[Camera]) -> tuple[np.ndarray, float]:
    """Return the centre [3] and the radius of a ball around what the cameras look at, which holds nearly all
    cameras."""
    places = np.stack([camera.c2w[:3, 3] for camera in cameras])
    middle = places.mean(axis=0)
    spread = float(np.linalg.norm(places - middle, axis=1).max())
    centre = focus_point(cameras)
    if np.linalg.norm(centre - middle) > 20 * spread:
        centre = middle  # nearly parallel views have no focus point that can be used
    n_views, distances = len(places), np.sort(np.linalg.norm(places - centre, axis=1))
    radius = float(np.quantile(distances, CAMERA_QUANTILE))
    # With three to ten cameras the quantile lies between the last two, so that one that strayed would count.
    # But where all others are in one place, it did not stray.
    if CAMERA_QUANTILE * (n_views - 1) > n_views - 2 > 0:
        last_but_one, last = distances[-2:].tolist()
        if last > STRAYED * last_but_one > 1e-3 * radius:
            radius = last_but_one
    return centre, radius


def _near(cameras: list[Camera], points: np.ndarray | None, unit: float) -> float:
    """Return the distance from a camera at which matter may begin, in units of `unit`."""
    if points is None or len(points) == 0:
        return NEAR_CAMERA
    points = points[:: max(1, len(points) // MOST_POINTS)]
    depths = np.concatenate([(camera.c2w[:3, 3] - points) @ camera.c2w[:3, 2] for camera in cameras])
    ahead = depths[depths > 0]
    if len(ahead) == 0:
        return NEAR_CAMERA
    return min(NEAR_CAMERA * 4, NEAR_SHARE * float(np.quantile(ahead, NEAR_QUANTILE)) / unit)
