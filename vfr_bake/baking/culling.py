"""Which cells are stored: those that matter, by what leaving the others out loses.

A sample's own weight says little: in a fog every sample of a ray weighs next to nothing, and all of them
together are the picture. What counts is the sum along a ray, so that a floor on the weights is taken only
where the pictures without the cells below it, on views that nothing else looks at, lose next to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from player.errors import TrainingError
from vfr_bake.baking.loss import HeldOut
from vfr_bake.baking.visibility import Progress, close_gaps, marked_cells, occupied_cells
from vfr_bake.kernels.march import chebyshev_distance, render_features
from vfr_bake.rendering.samples import LIMITS
from vfr_bake.training.model_file import Model

FLOORS = (0.02, 0.01, 0.005, 0.002, 0.001)
"""Weights that a sample must have in some view for its cell to be stored; the first that loses little enough
is taken, and where none does, nothing is left out."""


@dataclass(frozen=True, eq=False)
class Cells:
    """What is stored of a box."""

    visible: np.ndarray
    """[n, n, n] bool."""
    floor: float
    """The weight that decided; 0 where every cell that may hold matter is stored."""
    lost: dict[float, float]
    """Expected loss in dB of each floor that was tried, on its own."""
    removed: float
    """Share of the cells that may hold matter which are not stored."""

    def report(self) -> str:
        """What was left out and what that changed, in words."""
        tried = ", ".join(f"{loss:.3f} dB at {floor:g}" for floor, loss in self.lost.items())
        if not self.floor:
            return f"none: leaving out what weighs little loses too much ({tried or 'nothing weighs enough'})"
        return (
            f"{self.removed:.0%} of the cells that the model may hold matter in: no view gives them a weight "
            f"of {self.floor:g}; expected loss by the floor of weight, part of that after 'grid': {tried}"
        )


def whole(model: Model, resolution: int) -> Cells:
    """Every cell that the model holds matter in."""
    return Cells(occupied_cells(model, resolution), 0.0, {}, 0.0)


def cull(
    model: Model, resolution: int, held_out: HeldOut, floor: float | None, most_db: float, progress: Progress
) -> Cells:
    """The cells of a grid of `resolution` that weigh something in some view, gaps of one cell between them
    closed.

    `floor` is the weight that they must have, or None for the highest of FLOORS that is expected to lose no
    more than `most_db`. Raises TrainingError when no cell weighs a `floor` that was asked for.
    """
    held = occupied_cells(model, resolution)
    floors = FLOORS if floor is None else (floor,)
    marks = marked_cells(model, resolution, floors, progress)
    least = _loss(model, held_out, held)
    lost: dict[float, float] = {}
    for level, tried in enumerate(floors):
        visible = close_gaps(np.ascontiguousarray(marks[..., level]).view(bool))
        if not visible.any():
            continue
        lost[tried] = max(_loss(model, held_out, visible) - least, 0.0)
        if lost[tried] <= most_db or floor is not None:
            removed = 1 - float(visible.sum()) / max(int(held.sum()), 1)
            return Cells(visible, tried, lost, max(removed, 0.0))
    if floor is not None:
        raise TrainingError(
            f"no cell weighs {floor} in any training view: the model is empty or a thin fog: "
            "train longer, or lower --weight-floor"
        )
    return Cells(held, 0.0, lost, 0.0)


def _loss(model: Model, held_out: HeldOut, cells: np.ndarray) -> float:
    """Expected loss in dB of the model where only `cells` [n, n, n] bool hold matter."""
    distance = np.empty(cells.shape, np.uint8)
    chebyshev_distance(cells, distance)
    features = np.zeros((len(held_out.rays_o), model.field.config.n_channels), np.float32)
    opacity, depth = np.zeros((2, len(features)), np.float32)
    render_features(
        held_out.rays_o, held_out.rays_d, np.float32(model.occupancy.step), distance,
        *model.field.kernel_arguments(), LIMITS, features, opacity, depth,
    )  # fmt: skip
    return held_out.loss_of(features, opacity)
