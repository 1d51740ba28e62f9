"""Bake of a tiny model, so that all code that a bake compiles is compiled and kept while other work goes on.

python -m vfr_bake.rehearsal
"""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from vfr_bake.baking.bake import bake
from vfr_bake.config import BakeConfig, FieldOptions, TrainConfig
from vfr_bake.data.demo import demo_scene
from vfr_bake.training.model_file import Model, trained_model
from vfr_bake.training.trainer import Trainer

RADIUS = 0.4
"""Radius of the ball that is baked, in model units."""
CELLS = 32
"""Cells along an axis of the occupancy grid that marks the ball, and of the stored grid."""
LATER = 10
"""Nice value, on systems that have one, so that the other work comes first."""


def untrained_model() -> Model:
    """Make the model of a ball: an untrained field, seen by small cameras."""
    scene = demo_scene(size=32, n_train=8, n_test=1)
    options = FieldOptions(log2_table_size=12)
    config = TrainConfig(device="cpu", field=options, occupancy_resolution=CELLS)
    model = trained_model(Trainer(scene, config), scene, {})
    middles = (np.indices((CELLS,) * 3) + 0.5) * 2 / CELLS - 1
    model.occupancy.set_occupied(np.linalg.norm(middles, axis=0) < RADIUS)
    return model


def main() -> None:
    """Bake the untrained model, and throw the asset away."""
    if hasattr(os, "nice"):
        os.nice(LATER)
    with TemporaryDirectory() as folder:
        # The loss that this preset allows lets coarser levels show parts of the ball, so their code runs,
        # too.
        config = BakeConfig(preset="fast", resolution=CELLS, refine_steps=2, check_views=1)
        bake(untrained_model(), Path(folder) / "asset", config, lambda *_: None)


if __name__ == "__main__":
    main()
