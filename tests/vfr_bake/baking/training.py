"""A model of a scene, without a file in between."""

from __future__ import annotations

from vfr_bake.config import TrainConfig
from vfr_bake.data.scene import Scene
from vfr_bake.training.model_file import Model, trained_model
from vfr_bake.training.trainer import Trainer


def trained(scene: Scene, config: TrainConfig) -> Model:
    """What `vfr-train` would have written."""
    trainer = Trainer(scene, config)
    for _ in trainer.run():
        pass
    return trained_model(trainer, scene, {})
