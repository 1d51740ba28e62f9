"""Posed pictures of one scene, in the frame that everything after the data set works in.

The model frame puts the scene's cubic box at [-1, 1]³, whatever the scene's unit; `world_from_model` undoes
it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from player.cameras import Camera
from player.errors import DataError, ShapeError
from vfr_bake.data.bounds import scene_box


@dataclass(frozen=True)
class PosedImages:
    """Pictures and where they were taken from."""

    cameras: list[Camera]
    """As many as there are pictures, of the pictures' size; in a `Scene`, in the model frame."""
    images: np.ndarray
    """[n_views, height, width, 4] uint8, sRGB and straight (not premultiplied) alpha."""

    def __post_init__(self) -> None:
        shape = self.images.shape
        if len(shape) != 4 or shape[3] != 4 or shape[0] != len(self.cameras) or self.images.dtype != np.uint8:
            raise ShapeError(
                f"images: expected [{len(self.cameras)}, height, width, 4] uint8, "
                f"got {list(shape)} {self.images.dtype}"
            )
        for camera in self.cameras:
            if (camera.height, camera.width) != shape[1:3]:
                raise ShapeError(
                    f"{camera.name}: camera: expected {shape[2]}x{shape[1]} pixels as its picture has, "
                    f"got {camera.width}x{camera.height}"
                )


@dataclass(frozen=True)
class Scene:
    """A scene to train on and to test with."""

    name: str
    train: PosedImages
    test: PosedImages
    """Views that training never sees; none when there are too few to spare one."""
    has_alpha: bool
    """Whether any picture has a pixel that is not opaque."""
    world_from_model: np.ndarray
    """[4, 4] float64: uniform scale and translation; the model's [-1, 1]³ is the scene's box in the world."""


def build_scene(name: str, train: PosedImages, test: PosedImages) -> Scene:
    """A `Scene` out of pictures with cameras in the world: finds the box and moves the cameras to the model
    frame.

    `train`, `test`: world frame. The box is found from the training views alone.

    Raises DataError for fewer than two training views: depth is not to be had from one.

    >>> from vfr_bake.data.demo import demo_views
    >>> train, test = demo_views(size=16, n_train=4, n_test=1)
    >>> scene = build_scene("tiny", train, test)
    >>> scene.has_alpha, scene.train.images.shape
    (True, (4, 16, 16, 4))
    """
    if len(train.cameras) < 2:
        raise DataError(f"{name}: training views: expected at least 2, got {len(train.cameras)}")
    has_alpha = any(bool((views.images[..., 3] < 255).any()) for views in (train, test))
    centre, half = scene_box(train.cameras, train.images[..., 3] if has_alpha else None)
    world_from_model = np.eye(4)
    world_from_model[:3, :3] *= half
    world_from_model[:3, 3] = centre
    model_from_world = np.linalg.inv(world_from_model)

    def moved(views: PosedImages) -> PosedImages:
        return PosedImages([camera.transformed(model_from_world) for camera in views.cameras], views.images)

    return Scene(name, moved(train), moved(test), has_alpha, world_from_model)
