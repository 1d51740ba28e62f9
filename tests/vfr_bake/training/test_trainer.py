"""Training: it learns the built-in scene, ends when told, repeats itself, and survives bad steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from player.errors import TrainingError
from vfr_bake.config import FieldOptions, TrainConfig
from vfr_bake.data.demo import demo_scene
from vfr_bake.data.scene import Scene
from vfr_bake.training.evaluation import evaluate
from vfr_bake.training.trainer import Trainer

FIELD = FieldOptions(n_levels=8, max_resolution=64, log2_table_size=14, head_width=32, density_width=16)


def config(**changes: object) -> TrainConfig:
    settings = {
        "steps": 220,
        "minutes": 5.0,
        "batch_samples": 8192,
        "occupancy_resolution": 32,
        "pilot_steps": 60,
    }
    return TrainConfig(field=FIELD, **(settings | changes))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return demo_scene(size=48, n_train=20, n_test=3)


def test_it_learns_the_scene(scene: Scene) -> None:
    trainer = Trainer(scene, config())
    white = np.ones(3)
    before = np.mean([s.psnr for s in evaluate(trainer.field, trainer.sampler, scene.test, white)])
    reports = list(trainer.run())
    after = np.mean([s.psnr for s in evaluate(trainer.field, trainer.sampler, scene.test, white)])
    assert len(reports) == 220 and trainer.n_bad_steps == 0
    assert after > before + 6 and after > 18


def test_same_seed_same_field(scene: Scene) -> None:
    tables = []
    for _ in range(2):
        trainer = Trainer(scene, config(steps=25, pilot_steps=10))
        for _ in trainer.run():
            pass
        tables.append(trainer.field.grid.table.detach().clone())
    assert torch.equal(*tables)


def test_the_minutes_end_it(scene: Scene) -> None:
    reports = list(Trainer(scene, config(steps=10**6, minutes=0.02)).run())
    assert 0 < len(reports) < 10**6
    assert reports[-1].seconds < 10


def test_a_step_without_a_finite_loss_changes_nothing_and_many_stop(scene: Scene) -> None:
    trainer = Trainer(scene, config())
    with torch.no_grad():
        trainer.field.head.out.bias.fill_(math.nan)
        for parameter in trainer.pilot.parameters():
            parameter.fill_(math.nan)
    before = trainer.field.grid.table.detach().clone()
    with pytest.raises(TrainingError, match="not a finite number for 20 steps: lower --network-rate"):
        list(trainer.run())
    assert trainer.n_bad_steps == 20
    assert torch.equal(before, trainer.field.grid.table)


def test_pictures_without_alpha_train_over_their_own_background(scene: Scene) -> None:
    opaque = [image | np.array([0, 0, 0, 255], np.uint8) for image in scene.train.images]
    views = type(scene.train)(scene.train.cameras, opaque)
    photographs = Scene(scene.name, views, scene.test, False, scene.world_from_model)
    assert len(list(Trainer(photographs, config(steps=5)).run())) == 5
