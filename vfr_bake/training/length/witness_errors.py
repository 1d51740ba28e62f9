"""How far a field is off at its witnesses while it is trained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from player.cameras.camera import Camera
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.render import Sampler, render_rays
from vfr_bake.training.length.witness_loss import WitnessLoss

N_LOOKED_AT = 15_000
"""Witnesses at most: a look at them takes half a second of an object, one or two of a capture."""


class WitnessErrors:
    """The rays and the photographs of some witnesses."""

    def __init__(
        self, witnesses: Witnesses, cameras: Sequence[Camera], background: np.ndarray | None
    ) -> None:
        """`cameras`: of the training views, model frame. `background`: [3] in [0, 1], over which pictures are
        compared; None for the mean colour of the photographs."""
        some = witnesses.some(N_LOOKED_AT)
        self._rays = some.rays(cameras)
        self._background = some.rgba[:, :3].mean(axis=0) / 255 if background is None else background
        self.loss = WitnessLoss(some, self._background)
        """Compares the errors of two times."""

    def errors(self, field: VfrField, sampler: Sampler) -> np.ndarray:
        """[n] mean square errors over the three channels, of the pictures that `field` gives by now."""
        colours, opacity = render_rays(field, sampler, *self._rays)
        return self.loss.errors(colours + (1 - opacity[:, None]) * self._background)
