"""Length of a training: at most the minutes or the steps that are asked for, and less if the scene has
nothing more to teach.

The learning rate is high for the first half of a training and falls in the second
(`vfr_bake.training.optimiser.rate_factor`). While it is high, the error is measured at the witnesses, pixels
that are not learned from: FIRST_LOOK seconds after the start, or after FIRST_SHARE of the training if that is
less, and then whenever the time has grown by the factor GROWTH. So the time has doubled after every two
looks. If the last doubling has gained less than FLAT_DB, twice in a row and beyond chance, another one is not
worth it: the second half of the training begins at once, and takes as long as the first did.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from vfr_bake.training.length.witness_loss import WitnessLoss
from vfr_bake.training.optimiser import HELD

FIRST_LOOK = 60.0
"""Seconds of training before the first look, at most."""
FIRST_SHARE = 0.1
"""Share of the training before the first look, at most. Four looks, the fewest that shorten a training, then
fit into its first half."""
GROWTH = math.sqrt(2)
"""Factor between the times of two looks."""
LOOKS_OF_A_DOUBLING = 2
"""Number of looks after which the time has doubled."""
FLAT_DB = 0.15
"""Gain in dB from doubling the time, below which the error counts as flat."""
FLAT_LOOKS = 2
"""Number of looks in a row that must find the error flat before the training is shortened."""


class Duration:
    """Length of a training, which gets shorter when the error is flat.

    >>> short = Duration(steps=100, minutes=1.0)
    >>> short.progress(50, 6.0), short.progress(50, 60.0)
    (0.5, 1.0)
    """

    def __init__(self, steps: int, minutes: float) -> None:
        """`steps`, `minutes`: the most that the training may take, each more than 0; `minutes` may be
        infinite."""
        self._steps = steps
        self._seconds = 60 * minutes
        self._next_look = min(FIRST_LOOK, FIRST_SHARE * self._seconds)
        self._errors: list[np.ndarray] = []
        """Errors [n_witnesses] at each of the last LOOKS_OF_A_DOUBLING looks."""
        self._n_flat = 0
        self.ended_early = False
        """True once the error was found flat, and the training shortened."""

    def progress(self, step: int, seconds: float) -> float:
        """Return the share of the training that is done after `step` steps and `seconds`: from 0 on, and 1 or
        more at its end."""
        return max(step / self._steps, seconds / self._seconds)

    def look(self, step: int, seconds: float, measure: Callable[[], tuple[WitnessLoss, np.ndarray]]) -> None:
        """Look at the errors, if it is time to, and shorten the training if they are flat.

        `measure` returns the loss of the witnesses, and their current errors [n_witnesses].
        """
        if seconds < self._next_look or self.progress(step, seconds) >= HELD:
            return
        self._next_look = seconds * GROWTH
        witnesses, errors = measure()
        if len(self._errors) == LOOKS_OF_A_DOUBLING:
            change = witnesses.loss(self._errors.pop(0), errors)
            gain = 2 * (change.spread or 0.0) - change.db  # two standard errors above what was measured
            self._n_flat = self._n_flat + 1 if gain < FLAT_DB else 0
        self._errors.append(errors)
        if self._n_flat == FLAT_LOOKS:
            self.ended_early = True
            self._seconds = min(self._seconds, seconds / HELD)

    def state(self) -> dict[str, Any]:
        """Return all that later looks depend on, as tensors and plain values, without the length asked
        for."""
        return {
            "next_look": self._next_look,
            "errors": [torch.from_numpy(errors) for errors in self._errors],
            "n_flat": self._n_flat,
            "shortened_to": self._seconds if self.ended_early else None,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned."""
        self._next_look, self._n_flat = state["next_look"], state["n_flat"]
        self._errors = [errors.numpy() for errors in state["errors"]]
        if state["shortened_to"] is not None:
            self.ended_early = True
            self._seconds = min(self._seconds, state["shortened_to"])
