"""Witnesses: pixels of the training views that training never draws, for a bake to be measured against.

The test split is there to report on, so nothing may be chosen by it. What a bake loses is therefore measured
on pixels of the training split that are kept apart before training begins, of two kinds:

- *single pixels*, alike many of every view. They cover the whole scene evenly, but the model has learned the
  pixels beside them, and is better there than on a view that it does not know.
- pixels of a few *whole views*, of which training draws none. These views are to the model what test views
  are, but there are only a few of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vfr_bake.data.capture import PosedImages
from vfr_bake.data.view_pixels import ViewPixels, spread

N_WITNESSES = 60_000
"""Number of witnesses at most; half of them are of whole views, where there are any."""
MOST_OF_A_VIEW = 0.02
"""Largest share of a view's pixels that are kept as single pixels: a small scene needs its pixels itself."""
FEWEST_VIEWS, VIEWS_OF_A_WHOLE, MOST_WHOLE = 20, 25, 4
"""Whole views are kept from as many training views on, about one in so many, and at most so many."""
SEED = 20
"""Seed of the choice, which is the same whatever the seed of the training is."""


@dataclass(frozen=True, eq=False)
class Witnesses(ViewPixels):
    """Pixels that training has not learned from, view after view."""

    whole: np.ndarray
    """[n_whole] int32, ascending: the views of which training draws no pixel at all."""

    def learned(self) -> np.ndarray:
        """[n_learned] int64, ascending: the views that training draws from."""
        return np.setdiff1d(np.arange(len(self.counts)), self.whole)


def choose_witnesses(views: PosedImages) -> Witnesses:
    """Choose the witnesses of training `views`; the same pictures' sizes always give the same choice.

    Single pixels are drawn at random, one from each of as many equally long runs of a view's pixels as it has
    witnesses, the same number from every view, and at most MOST_OF_A_VIEW of it. Pictures that are too small
    for that have none.

    >>> from vfr_bake.data.demo import demo_views
    >>> train, _ = demo_views(16, 20, 1)
    >>> chosen = choose_witnesses(train)
    >>> chosen.whole.tolist(), chosen.counts.tolist()[8:13]
    ([10], [5, 5, 256, 5, 5])
    """
    n_views = len(views.cameras)
    n_pixels = np.array([camera.width * camera.height for camera in views.cameras])
    whole = whole_views(n_views)
    learned = np.setdiff1d(np.arange(n_views), whole)
    n_of_whole = N_WITNESSES // 2 if len(whole) else 0
    counts = np.zeros(n_views, np.int32)
    counts[whole] = np.minimum(_shares(n_of_whole, len(whole)), n_pixels[whole])
    most = (MOST_OF_A_VIEW * n_pixels[learned]).astype(int)
    counts[learned] = np.minimum(_shares(N_WITNESSES - n_of_whole, len(learned)), most)
    random = np.random.default_rng(SEED)
    pixels = [spread(n, of, random) for n, of in zip(counts.tolist(), n_pixels.tolist(), strict=True)]
    rgba = [views.pixels(view, rows) for view, rows in enumerate(pixels)]
    return Witnesses(counts, np.concatenate(pixels).astype(np.int32), np.concatenate(rgba), whole)


def whole_views(n_views: int) -> np.ndarray:
    """[n_whole] int32: the numbers of the whole views that are kept of `n_views`, spread evenly.

    >>> [len(whole_views(n)) for n in (19, 20, 37, 38, 88, 1000)], whole_views(100).tolist()
    ([0, 1, 1, 2, 4, 4], [12, 37, 62, 87])
    """
    wanted = max(round(n_views / VIEWS_OF_A_WHOLE), 1) if n_views >= FEWEST_VIEWS else 0
    n_whole = min(wanted, MOST_WHOLE)
    return ((2 * np.arange(n_whole) + 1) * n_views // max(2 * n_whole, 1)).astype(np.int32)


def _shares(total: int, n: int) -> np.ndarray:
    """[n] int64: whole numbers that differ by at most one and sum to `total`."""
    return np.diff(np.arange(n + 1) * total // max(n, 1))
