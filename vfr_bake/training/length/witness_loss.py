"""Loss of pictures against photographs, measured by errors at the witnesses (`vfr_bake.data.witnesses`).

Letters: e is the mean square error of a witness over its three channels, between 8-bit pictures as in an
evaluation; P is the mean of e over the patches, and W_v is the mean of e over the pixels of the whole view v.
The loss of `after` compared with `before` is

    loss = 1/2 dB(P) + 1/2 mean_v dB(W_v),    dB(E) = 10 log10(E_after / E_before),

in which each term is a difference of PSNRs. If there is only one kind of witness, it has all of the weight.
Patches are taken from all views, but overstate the loss a little, because the model has learned the pixels
around them. Whole views are like test views, but there are four at most. The weights are those that came
nearest to the loss on all test views, over several scenes (docs/notes/2026-11-29-patches-of-witnesses.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.files.images import to_8_bit
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.training.scores.metrics import ROUNDING_ERROR, over_background

PATCH_WEIGHT = 1 / 2
"""Weight of the patches if there are whole views too."""
BLOCKS_OF_A_VIEW = 16
"""Number of runs of rows into which the witnesses of a view are split for the jackknife, if it is the only
one with patches, or the only whole one."""
T_FACTORS = {2: 1.84, 3: 1.32, 4: 1.20}
"""Number of standard errors, by the number of views from which they are estimated, within which a mean lies
as often as within one that is known exactly: Student's t distribution."""


class Loss(NamedTuple):
    """Loss of some pictures against photographs, compared with other pictures."""

    db: float
    """Loss in dB; less than 0 if they are better."""
    spread: float | None
    """Standard error in dB; None if the loss is not measured but expected."""
    widening: float = 0.0
    """dB by which the standard error is stated wider, because some of it is estimated from few views. Choices
    do not take it into account; warnings do."""

    @property
    def stated(self) -> float | None:
        """The standard error in dB as it is stated; None if the loss is not measured but expected."""
        return None if self.spread is None else self.spread + self.widening

    @property
    def most(self) -> float:
        """A likely upper bound of the loss in dB: one standard error above what was measured."""
        return self.db + (self.spread or 0.0)

    @property
    def worst(self) -> float:
        """A loss in dB that is hardly ever exceeded: two standard errors above what was measured."""
        return self.db + 2 * (self.spread or 0.0)

    @property
    def least(self) -> float:
        """A likely lower bound of the loss in dB: one stated standard error below what was measured."""
        return self.db - (self.stated or 0.0)

    def __str__(self) -> str:
        if self.stated is None:
            return f"an expected {self.db:.2f} dB"
        return f"{self.db:.2f} dB (give or take {self.stated:.2f})"


class WitnessLoss:
    """Photographs at the witnesses, and the blocks of witnesses that are left out together by the
    jackknife."""

    def __init__(self, witnesses: Witnesses, background: np.ndarray) -> None:
        """`background`: [3] in [0, 1], over which pictures are compared."""
        self._photographs = _levels(over_background(witnesses.rgba, background))
        views = witnesses.views()
        self.is_whole = is_whole = np.isin(views, witnesses.whole)
        """[n_witnesses] bool: true for witnesses of whole views."""
        n_whole = len(np.unique(views[is_whole]))  # a view that is masked as a whole has no witness
        for number, kind in enumerate((~is_whole, is_whole)):
            if len(np.unique(views[kind])) == 1:
                run = np.arange(int(kind.sum())) * BLOCKS_OF_A_VIEW // int(kind.sum())
                views[kind] = len(witnesses.counts) + number * BLOCKS_OF_A_VIEW + run
        _, self._block = np.unique(views, return_inverse=True)
        self._n_blocks = int(self._block.max()) + 1
        self._kinds = [np.unique(self._block[kind]) for kind in (~is_whole, is_whole) if kind.any()]
        """Numbers of the blocks of each kind of witness that there is: of the patches and of the whole views,
        one block for each view, or the parts of the only one."""
        self._weights = (PATCH_WEIGHT, 1 - PATCH_WEIGHT) if len(self._kinds) == 2 else (1.0,)
        self._by_view = [n_whole > 1 and blocks is self._kinds[-1] for blocks in self._kinds]
        """For each kind of witness, whether its blocks are whole views, so that the loss is the mean of the
        views' own losses."""
        self._n = np.bincount(self._block, minlength=self._n_blocks)

    def errors(self, rgb: np.ndarray) -> np.ndarray:
        """Return the mean square errors [n_witnesses] of colours [n_witnesses, 3] in [0, 1], after rounding
        them to 8 bits."""
        return ((_levels(rgb) - self._photographs) ** 2).mean(axis=1)

    def loss(self, before: np.ndarray, after: np.ndarray) -> Loss:
        """Return the loss of the errors `after` [n_witnesses], compared with the errors `before`.

        The spread is found by a jackknife: every view (or every part of the only view of a kind) is left out
        once. Whole views and not pixels are left out, because errors within a view are correlated. What is
        estimated from few views is stated wider by T_FACTORS.
        """
        db, variance, stated = 0.0, 0.0, 0.0
        for (lost, without), weight in zip(self._of_kinds(before, after), self._weights, strict=True):
            db += weight * lost
            changes = weight * (without - without.mean())
            of_kind = (len(changes) - 1) / len(changes) * float((changes**2).sum())
            variance += of_kind
            stated += of_kind * T_FACTORS.get(len(changes), 1.0) ** 2
        spread = float(np.sqrt(variance))
        return Loss(db, spread, float(np.sqrt(stated)) - spread)

    def _of_kinds(self, before: np.ndarray, after: np.ndarray) -> list[tuple[float, np.ndarray]]:
        """Return, for each kind of witness, its loss in dB and the losses [n_blocks] without each block."""
        sums = np.stack([np.bincount(self._block, e, self._n_blocks) for e in (before, after)], axis=1)
        return [
            _with_and_without(sums[blocks], self._n[blocks], by_view)
            for blocks, by_view in zip(self._kinds, self._by_view, strict=True)
        ]

    def described(self) -> str:
        """Return a sentence that says what the loss is measured on."""
        return (
            f"The loss is measured on {len(self._photographs):,} pixels of the photographs that training did "
            "not learn from."
        )


def _with_and_without(sums: np.ndarray, n: np.ndarray, by_view: bool) -> tuple[float, np.ndarray]:
    """Return the loss in dB of some blocks, and the losses [n_blocks] without each of them.

    Args:
        sums: [n_blocks, 2] sums of the errors before and after.
        n: [n_blocks] number of witnesses of each block.
        by_view: whether the loss is the mean of the blocks' own losses, of which there must be two or more,
            or the loss of all their pixels together.
    """
    if by_view:
        each = _decibels(sums / n[:, None])
        return float(each.mean()), (each.sum() - each) / (len(n) - 1)
    total = sums.sum(axis=0)
    left = np.maximum(n.sum() - n, 1)[:, None]
    return float(_decibels(total / n.sum())), _decibels((total - sums) / left)


def _levels(rgb: np.ndarray) -> np.ndarray:
    """Return colours [n, 3] float64 in [0, 1], clipped and rounded to 8 bits as pictures are for a
    comparison."""
    return to_8_bit(rgb) / 255


def _decibels(errors: np.ndarray) -> np.ndarray:
    """Return the dB [...] between mean square errors [..., 2], before and after; an error counts as no less
    than that of rounding."""
    least = np.maximum(errors, ROUNDING_ERROR)
    return 10 * np.log10(least[..., 1] / least[..., 0])
