"""How well a field shows what lies between its pictures, told by the witnesses when training ends.

Fog and holes that no training picture shows are seen from elsewhere alone: on pixels of the pictures that are
learned from their error is small. Whole pictures that are kept apart show them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vfr_bake.training.scores.metrics import decibels

MOST_APART = 4.0
"""dB by which whole pictures may be worse than pixels of the learned ones: they are by 1.3 dB in can and by
0.8 dB in the built-in scene. Where fog stood before can's floor, its test views were worse than the views
that it had learned from by 6 to 8 dB."""


class WitnessPsnr(NamedTuple):
    """PSNR in dB at the witnesses; None where there are none of a kind."""

    every: float
    patches: float | None
    """In patches of the pictures that are learned from."""
    whole: float | None
    """At pixels of whole pictures that are not."""

    def lines(self) -> list[str]:
        """What to say of it when training ends, for whoever took the pictures.

        >>> WitnessPsnr(34.3, 35.52, 33.27).lines()
        ['pixels kept apart: 35.5 dB in pictures that are learned from, 33.3 dB in whole ones that are not']
        >>> WitnessPsnr(29.0, 33.0, 27.0).lines()[1]  # doctest: +ELLIPSIS
        'warning: views between the pictures are shown much worse than the pictures: fog or holes ...'
        """
        if self.patches is None or self.whole is None:
            return []
        lines = [
            f"pixels kept apart: {self.patches:.1f} dB in pictures that are learned from, "
            f"{self.whole:.1f} dB in whole ones that are not"
        ]
        if self.patches - self.whole > MOST_APART:
            lines.append(
                "warning: views between the pictures are shown much worse than the pictures: fog or holes "
                "that none of them shows: take more pictures, with smaller steps in between"
            )
        return lines


def witness_psnr(errors: np.ndarray, is_whole: np.ndarray) -> WitnessPsnr:
    """PSNR of the mean square errors [n] at witnesses, of which `is_whole` [n] says which are of whole
    pictures; no error counts as one of 1e-12.

    >>> witness_psnr(np.array([0.001, 0.01, 0.01, 0.019]), np.array([False, True, True, False]))
    WitnessPsnr(every=20.0, patches=20.0, whole=20.0)
    """
    errors = np.maximum(errors, 1e-12)
    patches, whole = (decibels(errors[kind].mean()) if kind.any() else None for kind in (~is_whole, is_whole))
    return WitnessPsnr(decibels(errors.mean()), patches, whole)
