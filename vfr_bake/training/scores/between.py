"""Check, when training ends, of how well a field shows views between its pictures, by the witnesses.

Fog and holes that no training picture shows can be seen only from other places. They cause hardly any error
at witnesses in the pictures that are learned from, but they do in whole pictures that are kept apart.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vfr_bake.training.scores.metrics import ROUNDING_ERROR, decibels

MOST_APART = 4.0
"""Difference in dB, between the PSNR at patches of learned pictures and that at whole pictures, above which a
warning is printed. It is 1.3 dB in can and 0.8 dB in the built-in scene. When there was fog before can's
floor, its test views were 6 to 8 dB worse than the views that it had learned from."""


class WitnessPsnr(NamedTuple):
    """PSNR in dB at the witnesses: at all of them, and by kind; None for a kind that does not exist."""

    every: float
    patches: float | None
    """At patches of the pictures that are learned from."""
    whole: float | None
    """At pixels of whole pictures that are not learned from."""

    def lines(self) -> list[str]:
        """Return the lines to print when training ends, for whoever took the pictures.

        >>> WitnessPsnr(34.3, 35.52, 33.27).lines()
        ['pixels kept apart: 35.5 dB in pictures that are learned from, 33.3 dB in whole ones that are not']
        >>> WitnessPsnr(29.0, 33.0, 27.0).lines()[1]  # doctest: +ELLIPSIS
        'warning: views between the pictures are shown much worse than the pictures: fog or holes ...'
        """
        if self.patches is None or self.whole is None:
            return []
        if self.patches >= decibels(ROUNDING_ERROR):  # nothing but background, which says nothing of fog
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
    """Return the PSNR for the mean square errors [n] at witnesses; `is_whole` [n] says which are of whole
    pictures. An error counts as no less than that of rounding to 8 bits, 58.9 dB.

    >>> witness_psnr(np.array([0.001, 0.01, 0.01, 0.019]), np.array([False, True, True, False]))
    WitnessPsnr(every=20.0, patches=20.0, whole=20.0)
    """

    def psnr(some: np.ndarray) -> float | None:
        return decibels(max(float(some.mean()), ROUNDING_ERROR)) if len(some) else None

    every = decibels(max(float(errors.mean()), ROUNDING_ERROR))
    return WitnessPsnr(every, psnr(errors[~is_whole]), psnr(errors[is_whole]))
