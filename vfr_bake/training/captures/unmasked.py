"""What is masked in the pictures is kept as no witness."""

from __future__ import annotations

import numpy as np

from vfr_bake.data.witnesses import Witnesses


def unmasked_witnesses(witnesses: Witnesses) -> Witnesses:
    """The witnesses that are opaque: what a bake shows where a picture is masked is no loss.

    >>> rgba = np.array([[9, 9, 9, 255], [9, 9, 9, 0]], np.uint8)
    >>> two = Witnesses(np.array([2], np.int32), np.array([3, 5], np.int32), rgba, np.zeros(0, np.int32))
    >>> unmasked_witnesses(two).pixels.tolist()
    [3]
    """
    seen = witnesses.rgba[:, 3] == 255
    counts = np.bincount(witnesses.views()[seen], minlength=len(witnesses.counts)).astype(np.int32)
    return Witnesses(counts, witnesses.pixels[seen], witnesses.rgba[seen], witnesses.whole)
