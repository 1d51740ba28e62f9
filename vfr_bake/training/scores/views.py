"""The test views of a data set that can be scored, of the scene that a model or an asset shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from player.cameras.camera import Camera
from player.errors import DataError
from player.terminal import printable
from vfr_bake.data.scene import Scene
from vfr_bake.data.store.capture import PosedImages

APART = 1e-3
"""Largest distance of two cameras that count as one, in model units, and largest difference between numbers
of their rotations. It is far above rounding, and a pixel at most in pictures of a thousand pixels."""
OTHER_LENS = 0.01
"""Largest difference of focal length and principal point, in widths and heights of the picture. Pictures that
are reduced lose up to a row and a column."""
N_NAMED = 3
"""Views that a line names."""


class Learned(NamedTuple):
    """The cameras that a model or an asset was trained with."""

    name: str
    """The file of the model or the folder of the asset."""
    cameras: list[Camera]
    """In the world frame."""
    world_from_model: np.ndarray
    """[4, 4], a similarity."""


def scored_views(
    scene: Scene, data: str, exposure: bool, learned: Sequence[Learned]
) -> tuple[PosedImages, list[str]]:
    """Return the test views of a scene that can be scored, with cameras in the world frame, and lines to
    print about the others.

    `data`: the data set's name. `exposure`: whether the exposure is fitted on the left half of each view.
    `learned`: what is compared with the views.

    Raises DataError: there is no such view, or a camera is not the one of equal name in `learned`.
    """
    for one in learned:
        check_cameras(scene, data, one)
    views, hidden = seen_views(scene.test, scene.masked, exposure)
    if not views.cameras:
        found = "got none" if not hidden else f"got {len(hidden)} that are masked"
        raise DataError(f"{data}: test views: expected at least 1 in which something is seen, {found}")
    lines = hidden_lines(hidden)
    names = {camera.name for one in learned for camera in one.cameras}
    known = [camera.name for camera in views.cameras if camera.name in names]
    if known:
        lines.append(
            f"warning: {len(known)} of {len(views.cameras)} test views were trained on ({_named(known)}): "
            "their quality says nothing about views between the pictures"
        )
    world = [camera.transformed(scene.world_from_model) for camera in views.cameras]
    return replace(views, cameras=world), lines


def check_cameras(scene: Scene, data: str, learned: Learned) -> None:
    """Raise DataError unless cameras of a scene have the poses and lenses of the cameras of equal name in
    `learned`. Pictures may differ in size; a scene with other names throughout is not compared."""
    there = {camera.name: camera for camera in learned.cameras}
    unit = np.cbrt(np.linalg.det(learned.world_from_model[:3, :3]))
    for camera in [*scene.train.cameras, *scene.test.cameras]:
        if camera.name in there and not _agree(
            camera.transformed(scene.world_from_model), there[camera.name], unit
        ):
            raise DataError(
                f"{data}: cameras: expected those that {learned.name} was trained with, got another pose or "
                f"lens of {printable(camera.name)}: give the data set of that training with the cameras that "
                "it had then (those of photographs are kept in sparse/), or train again"
            )


def _agree(a: Camera, b: Camera, unit: float) -> bool:
    """Return whether two cameras have one pose and one lens; `unit`: world units per model unit."""
    moved = np.abs(a.c2w - b.c2w).max(axis=0) / [1, 1, 1, unit]
    return bool(moved.max() <= APART) and np.allclose(_lens(a), _lens(b), rtol=OTHER_LENS, atol=OTHER_LENS)


def _lens(camera: Camera) -> np.ndarray:
    """Return the focal lengths and the principal point in widths and heights of the picture, [2, 2]."""
    pixels = np.array([[camera.fx, camera.fy], [camera.cx, camera.cy]])
    return pixels / [camera.width, camera.height]


def seen_views(views: PosedImages, masked: bool, exposure: bool) -> tuple[PosedImages, list[str]]:
    """Return the views that can be scored, and the names of those that cannot, because all of them is masked.

    `masked`: whether pixels that are not opaque are masked. `exposure`: whether the exposure is fitted on the
    left half of each view and the right half is scored; something must then be seen in either half.
    """
    if not masked:
        return views, []
    every = range(len(views.cameras))
    seen = [i for i in every if views.opaque(i) or _is_seen(views.images[i], exposure)]
    return views.some(seen), [views.cameras[i].name for i in every if i not in seen]


def _is_seen(rgba: np.ndarray, exposure: bool) -> bool:
    opaque = rgba[..., 3] == 255
    middle = opaque.shape[1] // 2
    parts = [opaque[:, :middle], opaque[:, middle:]] if exposure else [opaque]
    return all(part.any() for part in parts)


def hidden_lines(names: Sequence[str]) -> list[str]:
    """Return the line to print about views that cannot be scored, if there are any.

    >>> hidden_lines(["a.jpg", "b.jpg"]), hidden_lines([])
    (['test views that are masked, and so not scored: 2 (a.jpg, b.jpg)'], [])
    """
    return [f"test views that are masked, and so not scored: {len(names)} ({_named(names)})"] if names else []


def spread_order(n: int) -> np.ndarray:
    """Return the numbers 0 to n - 1 in an order of which every beginning is spread evenly, for views of which
    there may not be time for all.

    >>> spread_order(8).tolist()
    [0, 5, 2, 7, 4, 1, 6, 3]
    """
    golden = (5**0.5 - 1) / 2
    return np.argsort(np.argsort(golden * np.arange(n) % 1))


def _named(names: Sequence[str]) -> str:
    return printable(", ".join(names[:N_NAMED])) + (", ..." if len(names) > N_NAMED else "")
