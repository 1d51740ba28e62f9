"""The built-in scene as it might have been photographed, with changing exposure or with a ball that moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vfr_bake.config import FieldOptions, TrainConfig
from vfr_bake.data.demo import demo_capture
from vfr_bake.data.demo_solids import CENTRE, SCALE
from vfr_bake.data.scene import Scene, build_scene
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.evaluation import render_views
from vfr_bake.training.model_file import trained_model
from vfr_bake.training.trainer import Trainer


def settings(**changes: object) -> TrainConfig:
    field = FieldOptions(n_levels=8, max_resolution=128, log2_table_size=15, head_width=32, density_width=16)
    values = {
        "device": "cpu", "minutes": 60.0, "steps": 264, "batch_samples": 16384, "batch_rays": 256,
        "occupancy_resolution": 32, "pilot_steps": 60, "field": field,
    }  # fmt: skip
    return TrainConfig(**(values | changes))  # type: ignore[arg-type]


def changed_exposure(views: PosedImages, seed: int, strength: float) -> tuple[PosedImages, np.ndarray]:
    """Return the views, each with another exposure and white balance, and their gains [n_views, 3]."""
    random = np.random.default_rng(seed)
    n = len(views.images)
    gains = np.exp(strength * (random.normal(size=(n, 1)) + 0.3 * random.normal(size=(n, 3))))
    images = [image.copy() for image in views.images]
    for image, gain in zip(images, gains, strict=True):
        # Darken first, so that no colour is clipped.
        image[..., :3] = np.clip(0.7 * image[..., :3] * gain + 0.5, 0, 255).astype(np.uint8)
    return PosedImages(views.cameras, images), gains


def with_a_ball(views: PosedImages, seed: int, radius: float = 0.15) -> PosedImages:
    """Return the views with a red ball in each, at another place; `radius` in scene units."""
    random = np.random.default_rng(seed)
    images = [image.copy() for image in views.images]
    for camera, image in zip(views.cameras, images, strict=True):
        place = CENTRE + SCALE * random.uniform(-0.4, 0.4, 3)
        rays_o, rays_d = camera.rays()
        along = ((place - rays_o) * rays_d).sum(axis=1)
        apart = ((place - rays_o) ** 2).sum(axis=1) - along**2
        image[(apart < (SCALE * radius) ** 2).reshape(image.shape[:2])] = (220, 30, 40, 255)
    return PosedImages(views.cameras, images)


def scene_of(exposure: float = 0.0, ball: bool = False, seed: int = 0, size: int = 64) -> Scene:
    """Return the built-in scene with changed `exposure` in all views, and a `ball` in training views."""
    capture = demo_capture(size=size, n_train=40, n_test=4)
    train, test = capture.train, capture.test
    if exposure:
        train, _ = changed_exposure(train, seed, exposure)
        test, _ = changed_exposure(test, seed + 1, exposure)
    if ball:
        train = with_a_ball(train, seed)
    return build_scene(replace(capture, train=train, test=test))


def trained(scene: Scene, **changes: object) -> Trainer:
    """Return a trainer that has run all its steps."""
    trainer = Trainer(scene, settings(**changes))
    for _ in trainer.run():
        pass
    return trainer


def quality(trainer: Trainer, scene: Scene) -> float:
    """Return the mean PSNR of the test views in dB."""
    views = render_views(trained_model(trainer, scene, {}), scene.test)
    return float(np.mean([view.score().psnr for view in views]))
