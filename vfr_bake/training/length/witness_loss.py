"""What pictures lose against photographs, by their errors at the witnesses (`vfr_bake.data.witnesses`).

Letters: e is the mean square error of a witness over its three channels, between 8-bit pictures as in an
evaluation; P is the mean of e over the patches, and W_v that over the pixels of the whole view v. What
`after` loses compared with `before` is

    loss = 1/2 dB(P) + 1/2 mean_v dB(W_v),    dB(E) = 10 log10(E_after / E_before),

differences of PSNRs. Where there is one kind only, it has all of the weight. Patches are of all views, but
tell a little more than there is, because the model has learned what is around them. Whole views are seen as
test views are, but four views are few. The weights are those that came near to the loss on all test views,
over several scenes (docs/notes/2026-11-29-patches-of-witnesses.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.files.images import to_8_bit
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.training.scores.metrics import over_background

PATCH_WEIGHT = 1 / 2
"""Weight of the patches, where there are whole views too."""
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
        self.is_whole = is_whole = np.isin(views, witnesses.whole)
        """[n_witnesses] bool: which of them are of whole views."""
        if len(witnesses.whole) == 1:
            run = np.arange(int(is_whole.sum())) * BLOCKS_OF_A_VIEW // max(int(is_whole.sum()), 1)
            views[is_whole] = len(witnesses.counts) + run
        _, self._block = np.unique(views, return_inverse=True)
        self._n_blocks = int(self._block.max()) + 1
        self._kinds = [np.unique(self._block[kind]) for kind in (~is_whole, is_whole) if kind.any()]
        """The blocks of the patches, one for each view, and those of whole views."""
        self._weights = (PATCH_WEIGHT, 1 - PATCH_WEIGHT) if len(self._kinds) == 2 else (1.0,)
        several = len(witnesses.whole) > 1
        self._by_view = [several and blocks is self._kinds[-1] for blocks in self._kinds]
        """Whether the blocks of a kind are whole views, each of which has a loss of its own."""
        self._n = np.bincount(self._block, minlength=self._n_blocks)

    def errors(self, rgb: np.ndarray) -> np.ndarray:
        """[n_witnesses] mean square errors of colours [n_witnesses, 3] in [0, 1], rounded to 8 bits."""
        return ((_levels(rgb) - self._photographs) ** 2).mean(axis=1)

    def loss(self, before: np.ndarray, after: np.ndarray) -> Loss:
        """What errors `after` [n_witnesses] lose, compared with errors `before`.

        The spread is that of a jackknife: every view (or a part of the only whole view) is left out once,
        because errors within a view have much to do with each other.
        """
        db, variance = 0.0, 0.0
        for (lost, without), weight in zip(self._of_kinds(before, after), self._weights, strict=True):
            db += weight * lost
            changes = weight * (without - without.mean())
            variance += (len(changes) - 1) / len(changes) * float((changes**2).sum())
        return Loss(db, float(np.sqrt(variance)))

    def shows(self, before: np.ndarray, after: np.ndarray, db: float) -> bool:
        """Whether more than `db` is lost beyond chance: at all witnesses, and in the mean of the whole views,
        if there are any. Single pixels alone do not show it: some of what training has learned beside them
        no other view has.
        """
        of_last_kind, _ = self._of_kinds(before, after)[-1]
        return self.loss(before, after).least > db and of_last_kind > db

    def _of_kinds(self, before: np.ndarray, after: np.ndarray) -> list[tuple[float, np.ndarray]]:
        """For each kind its loss in dB, and [n_blocks] the losses without each of its blocks."""
        sums = np.stack([np.bincount(self._block, e, self._n_blocks) for e in (before, after)], axis=1)
        return [
            _with_and_without(sums[blocks], self._n[blocks], by_view)
            for blocks, by_view in zip(self._kinds, self._by_view, strict=True)
        ]

    def described(self) -> str:
        """What is measured on, in a sentence."""
        return (
            f"The loss is measured on {len(self._photographs):,} pixels of the photographs that training did "
            "not learn from."
        )


def _with_and_without(sums: np.ndarray, n: np.ndarray, by_view: bool) -> tuple[float, np.ndarray]:
    """The loss in dB of some blocks, and [n_blocks] the losses without each of them.

    Args:
        sums: [n_blocks, 2] errors added up, before and after.
        n: [n_blocks] how many there are of each.
        by_view: whether it is the mean of their own losses, of two blocks and more, or that of all of
            their pixels together.
    """
    if by_view:
        each = _decibels(sums / n[:, None])
        return float(each.mean()), (each.sum() - each) / (len(n) - 1)
    total = sums.sum(axis=0)
    left = np.maximum(n.sum() - n, 1)[:, None]
    return float(_decibels(total / n.sum())), _decibels((total - sums) / left)


def _levels(rgb: np.ndarray) -> np.ndarray:
    """[n, 3] float64 in [0, 1], clipped and rounded to 8 bits as pictures are before they are compared."""
    return to_8_bit(rgb) / 255


def _decibels(errors: np.ndarray) -> np.ndarray:
    """dB [...] between mean square errors [..., 2], before and after; no error counts as one of 1e-12."""
    least = np.maximum(errors, 1e-12)
    return 10 * np.log10(least[..., 1] / least[..., 0])
