"""Which cells a bake stores, of which grid, and how long the player's steps are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vfr_bake.baking.contracted import BLOCK, FLOOR_SHARE, lattice_step, weighty_cells
from vfr_bake.baking.visibility import Progress, occupied_cells, pixel_footprints, visible_cells
from vfr_bake.config import BakeConfig
from vfr_bake.training.model_file import Model


class Cells(NamedTuple):
    """What is stored."""

    visible: np.ndarray
    """[n, n, n] bool."""
    step: float
    """Of the march: model units, of an unbounded scene dphi of `player.contracted_rays`."""
    culled: str | None
    """What is left out, in words."""


def find_cells(model: Model, config: BakeConfig, progress: Progress) -> Cells:
    """The cells of an object's box, or of contracted space, that matter in some view.

    Raises TrainingError when nothing is seen.
    """
    choice = config.choice()
    if model.field.config.unbounded:
        resolution = min(config.resolution or choice.contracted_resolution, model.field.config.max_resolution)
        resolution -= resolution % BLOCK
        floor = config.weight_floor or choice.weight_floor * FLOOR_SHARE
        visible = weighty_cells(model, resolution, floor, progress)
        culled = (
            f"{1 - visible.mean():.1%} of contracted space: no view gives a cell there a weight of "
            f"{floor:g}; part of the loss after 'grid'"
        )
        return Cells(visible, lattice_step(resolution), culled)
    cell = float(np.median(pixel_footprints(model)))
    resolution = config.resolution or round(2 * choice.cells_per_pixel / cell)
    resolution = int(np.clip(resolution, 8, model.field.config.max_resolution))
    held = occupied_cells(model, resolution)
    step = float(model.occupancy.step)
    if config.no_cull:
        return Cells(held, step, None)
    visible = visible_cells(model, resolution, choice.weight_floor, progress)
    share = 1 - float(visible.sum()) / max(int(held.sum()), 1)
    culled = (
        f"{share:.0%} of the cells that the model may hold matter in: no view gives them a "
        f"weight of {choice.weight_floor:g}; part of the loss after 'grid'"
    )
    return Cells(visible, step, culled)
