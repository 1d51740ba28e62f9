"""Which cells a bake stores, and how long the player's steps through them are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vfr_bake.baking.contracted import WEIGHT_FLOOR, lattice_step, weighty_cells
from vfr_bake.baking.culling import cull, whole
from vfr_bake.baking.estimate import Plan
from vfr_bake.baking.loss import HeldOut
from vfr_bake.baking.visibility import Progress
from vfr_bake.config import BakeConfig
from vfr_bake.training.model_file import Model


class StoredCells(NamedTuple):
    """What is stored."""

    visible: np.ndarray
    """[n, n, n] bool: cells of the features' grid, or blocks of them."""
    step: float
    """Of the march: model units, of an unbounded scene dphi of `player.march.contracted`."""
    left_out: str | None
    """What is not stored, in words."""


def find_cells(
    model: Model, config: BakeConfig, plan: Plan, held_out: HeldOut, progress: Progress
) -> StoredCells:
    """The cells of an object's box, or of contracted space, that matter in some view.

    Raises TrainingError when nothing is seen.
    """
    resolution = plan.feature_resolution
    if model.field.config.unbounded:
        floor = config.weight_floor or WEIGHT_FLOOR
        visible = weighty_cells(model, resolution, floor, progress)
        left_out = (
            f"{1 - visible.mean():.1%} of contracted space: no view gives a cell there a weight of "
            f"{floor:g}; part of the loss after 'grid'"
        )
        return StoredCells(visible, lattice_step(plan.resolution), left_out)
    step = float(model.occupancy.step)
    if config.no_cull:
        return StoredCells(whole(model, resolution).visible, step, None)
    most_db = config.choice().culled_loss_db
    cells = cull(model, resolution, held_out, config.weight_floor, most_db, progress)
    return StoredCells(cells.visible, step, cells.report())
