"""Errors of a field at its witnesses while it is trained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from player.cameras.camera import Camera
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.render import Sampler, render_rays
from vfr_bake.training.length.witness_loss import WitnessLoss

N_LOOKED_AT = 15_000
"""Largest number of witnesses to look at. A look takes half a second for an object, and one or two seconds
for a capture."""


class WitnessErrors:
    """Rays and photographs of some witnesses, to measure a field against."""

    def __init__(
        self, witnesses: Witnesses, cameras: Sequence[Camera], background: np.ndarray | None
    ) -> None:
        """`cameras`: those of the training views, in the model frame. `background`: [3] in [0, 1], over which
        pictures are compared; None for the mean colour of the photographs."""
        some = witnesses.some(N_LOOKED_AT)
        self._rays = some.rays(cameras)
        self._background = some.rgba[:, :3].mean(axis=0) / 255 if background is None else background
        self.loss = WitnessLoss(some, self._background)
        """Computes the loss between the errors of two times."""

    def errors(self, field: VfrField, sampler: Sampler) -> np.ndarray:
        """Return the mean square errors [n], over the three channels, of what `field` now shows there."""
        colours, opacity = render_rays(field, sampler, *self._rays)
        return self.loss.errors(colours + (1 - opacity[:, None]) * self._background)
