"""What pictures lose against photographs, by their errors at the witnesses (`vfr_bake.data.witnesses`).

Letters: e is the mean square error of a witness over its three channels, between 8-bit pictures as in an
evaluation; S and W are the means of e over the single pixels and over the pixels of whole views. What `after`
loses compared with `before` is

    loss = 10 log10(E_after / E_before) dB,    E = 2/3 S + 1/3 W,

the difference of two PSNRs. Where there is one kind only, E is its mean.

A bake adds much the same error to single pixels as to views that the model does not know, but the model's own
error there is smaller: single pixels alone tell a larger loss than there is. Whole views have both errors as
test views have them, but four views are few: one that is hard counts too much. The weights are those that
came nearest to the loss on all test views, over several scenes (docs/notes/2026-11-23-witnesses.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.files.images import to_8_bit
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.training.scores.metrics import over_background

SINGLE_WEIGHT = 2 / 3
"""Weight of the single pixels, where there are whole views too."""
BLOCKS_OF_A_VIEW = 16
"""Where there is one whole view, its pixels are as many runs of rows, each of which is left out once."""


class Loss(NamedTuple):
    """What some pictures lose against photographs, compared with others."""

    db: float
    """In dB; less than 0 where they are better."""
    spread: float | None
    """Standard error in dB; None where the loss is not measured but expected."""

    @property
    def most(self) -> float:
        """The loss in dB that may well be: one standard error above what was measured."""
        return self.db + (self.spread or 0.0)

    @property
    def worst(self) -> float:
        """The loss in dB that is hardly exceeded: two standard errors above what was measured."""
        return self.db + 2 * (self.spread or 0.0)

    @property
    def least(self) -> float:
        """The loss in dB that the photographs show: one standard error below what was measured."""
        return self.db - (self.spread or 0.0)

    def __str__(self) -> str:
        if self.spread is None:
            return f"an expected {self.db:.2f} dB"
        return f"{self.db:.2f} dB (give or take {self.spread:.2f})"


class WitnessLoss:
    """The witnesses' photographs, and which of the witnesses belong together."""

    def __init__(self, witnesses: Witnesses, background: np.ndarray) -> None:
        """`background`: [3] in [0, 1], over which pictures are compared."""
        self._photographs = _levels(over_background(witnesses.rgba, background))
        views = witnesses.views()
        self._view = views.copy()
        self.is_whole = is_whole = np.isin(views, witnesses.whole)
        """[n_witnesses] bool: which of them are of whole views."""
        if len(witnesses.whole) == 1:
            run = np.arange(int(is_whole.sum())) * BLOCKS_OF_A_VIEW // max(int(is_whole.sum()), 1)
            views[is_whole] = len(witnesses.counts) + run
        _, self._block = np.unique(views, return_inverse=True)
        self._n_blocks = int(self._block.max()) + 1
        self._kinds = [np.unique(self._block[kind]) for kind in (~is_whole, is_whole) if kind.any()]
        """The blocks of the single pixels, and those of whole views."""
        self._weights = (SINGLE_WEIGHT, 1 - SINGLE_WEIGHT) if len(self._kinds) == 2 else (1.0,)
        self._n = np.bincount(self._block, minlength=self._n_blocks)

    def errors(self, rgb: np.ndarray) -> np.ndarray:
        """[n_witnesses] mean square errors of colours [n_witnesses, 3] in [0, 1], rounded to 8 bits."""
        return ((_levels(rgb) - self._photographs) ** 2).mean(axis=1)

    def loss(self, before: np.ndarray, after: np.ndarray) -> Loss:
        """What errors `after` [n_witnesses] lose, compared with errors `before`.

        The spread is that of a jackknife: every view (or a part of the only whole view) is left out once,
        because errors within a view have much to do with each other.
        """
        sums = np.stack([np.bincount(self._block, e, self._n_blocks) for e in (before, after)], axis=1)
        mean, changes = np.zeros(2), []
        for blocks, weight in zip(self._kinds, self._weights, strict=True):
            total, n = sums[blocks].sum(axis=0), self._n[blocks].sum()
            mean += weight * total / n
            if len(blocks) > 1:
                without = (total - sums[blocks]) / (n - self._n[blocks])[:, None]
                changes.append(weight * (without - total / n))
        variance = 0.0
        for change in changes:
            lost = _decibels(mean + change)
            variance += (len(lost) - 1) / len(lost) * float(((lost - lost.mean()) ** 2).sum())
        return Loss(float(_decibels(mean)), float(np.sqrt(variance)))

    def shows(self, before: np.ndarray, after: np.ndarray, db: float) -> bool:
        """Whether more than `db` is lost beyond chance: at all witnesses, and in the mean of the whole views,
        if there are any. Single pixels alone do not show it: some of what training has learned beside them
        no other view has.
        """
        if self.loss(before, after).least <= db:
            return False
        of_views = [
            _decibels(np.array([errors[self._view == view].mean() for errors in (before, after)]))
            for view in np.unique(self._view[self.is_whole])
        ]
        return not of_views or float(np.mean(of_views)) > db

    def described(self) -> str:
        """What is measured on, in a sentence."""
        return (
            f"The loss is measured on {len(self._photographs):,} pixels of the photographs that training did "
            "not learn from."
        )


def _levels(rgb: np.ndarray) -> np.ndarray:
    """[n, 3] float64 in [0, 1], clipped and rounded to 8 bits as pictures are before they are compared."""
    return to_8_bit(rgb) / 255


def _decibels(errors: np.ndarray) -> np.ndarray:
    """dB [...] between mean square errors [..., 2], before and after; no error counts as one of 1e-12."""
    least = np.maximum(errors, 1e-12)
    return 10 * np.log10(least[..., 1] / least[..., 0])
