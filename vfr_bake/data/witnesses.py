"""Witnesses: pixels of the training views that training never draws, on which the loss of a bake is measured.

The test split is for reporting results, so nothing may be chosen by it. The loss of a bake is therefore
measured on pixels of the training split that are set apart before training begins. There are two kinds:

- pixels of *patches*: squares, one in each of the other views, from which training draws no pixel. They cover
  the whole scene. The model knows the inside of a patch from other views alone, as it knows a test view. It
  shows single pixels far better, because it learned from the pixels all around them
  (docs/notes/2026-11-29-patches-of-witnesses.md).
- pixels of a few *whole views*, from which training draws no pixel. To the model these views are like test
  views, but there are only a few of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from player.cameras.camera import Camera
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.view_pixels import ViewPixels, spread

N_WITNESSES = 60_000
"""Number of witnesses at most; half of them are in whole views, if there are any."""
MOST_OF_A_VIEW = 0.02
"""Largest share of a view's pixels that is set apart as a patch, because a small scene needs its pixels for
training."""
PATCH = 64
"""Number of pixels along an edge of a patch, at most."""
FEWEST_VIEWS, VIEWS_OF_A_WHOLE, MOST_WHOLE = 20, 25, 4
"""Whole views are set apart if there are at least FEWEST_VIEWS training views: about one in VIEWS_OF_A_WHOLE,
and at most MOST_WHOLE."""
SEED = 20
"""Seed of the choice, which does not depend on the seed of the training."""


@dataclass(frozen=True, eq=False)
class Witnesses(ViewPixels):
    """Pixels that training does not learn from, view after view."""

    whole: np.ndarray
    """[n_whole] int32, ascending: the numbers of the views from which training draws no pixel at all."""

    def learned(self) -> np.ndarray:
        """Return the numbers of the views that training draws from, [n_learned] int64, ascending."""
        return np.setdiff1d(np.arange(len(self.counts)), self.whole)

    def patches(self, cameras: Sequence[Camera]) -> list[np.ndarray]:
        """Return the numbers [n] int64 of all pixels of each view's patch, the smallest rectangle that holds
        the view's witnesses; of a whole view, and of one without witnesses, none. `cameras`: one for each
        view.
        """
        found = [np.zeros(0, np.int64)] * len(self.counts)
        of_views = self.of_views()
        for view in self.learned().tolist():
            if not len(of_views[view]):
                continue
            rows, columns = np.divmod(of_views[view].astype(np.int64), cameras[view].width)
            numbers = np.arange(rows.min(), rows.max() + 1)[:, None] * cameras[view].width
            found[view] = (numbers + np.arange(columns.min(), columns.max() + 1)).ravel()
        return found


def choose_witnesses(views: PosedImages) -> Witnesses:
    """Choose the witnesses of training `views`. The choice depends on the sizes of the pictures alone.

    Every view that training draws from has a patch at a random place, with at most MOST_OF_A_VIEW of its
    pixels. Pictures that are too small for that have none. The pixels of a patch or of a whole view are
    divided into as many equally long runs as it has witnesses, and one pixel is drawn at random from each
    run. The first and the last pixel of a patch are always among them.

    >>> from vfr_bake.data.demo import demo_views
    >>> train, _ = demo_views(16, 20, 1)
    >>> chosen = choose_witnesses(train)
    >>> chosen.whole.tolist(), chosen.counts.tolist()[8:13]
    ([10], [4, 4, 256, 4, 4])
    """
    n_views = len(views.cameras)
    n_pixels = np.array([camera.width * camera.height for camera in views.cameras])
    whole = whole_views(n_views)
    learned = np.setdiff1d(np.arange(n_views), whole)
    n_of_whole = N_WITNESSES // 2 if len(whole) else 0
    counts = np.zeros(n_views, np.int32)
    counts[whole] = np.minimum(_shares(n_of_whole, len(whole)), n_pixels[whole])
    counts[learned] = _shares(N_WITNESSES - n_of_whole, len(learned))
    random = np.random.default_rng(SEED)
    pixels = [
        spread(n, of, random) if view in whole else _in_a_patch(n, camera, random)
        for view, (n, of, camera) in enumerate(
            zip(counts.tolist(), n_pixels.tolist(), views.cameras, strict=True)
        )
    ]
    counts = np.array([len(some) for some in pixels], np.int32)
    rgba = [views.pixels(view, rows) for view, rows in enumerate(pixels)]
    return Witnesses(counts, np.concatenate(pixels).astype(np.int32), np.concatenate(rgba), whole)


def _in_a_patch(n: int, camera: Camera, random: np.random.Generator) -> np.ndarray:
    """Return the numbers (row * width + column) of at most `n` pixels of a patch, [n_pixels] int64,
    ascending. Its first and its last pixel are among them."""
    width, height = camera.width, camera.height
    size = min(PATCH, math.isqrt(int(MOST_OF_A_VIEW * width * height)), width, height)
    row, column = random.integers(height - size + 1), random.integers(width - size + 1)
    chosen = spread(min(n, size**2), size**2, random)
    if len(chosen):
        chosen[0], chosen[-1] = 0, size**2 - 1
    rows, columns = np.divmod(chosen, max(size, 1))
    return (row + rows) * width + column + columns


def whole_views(n_views: int) -> np.ndarray:
    """Return the numbers of the whole views to set apart from `n_views`, [n_whole] int32, spread evenly.

    >>> [len(whole_views(n)) for n in (19, 20, 37, 38, 88, 1000)], whole_views(100).tolist()
    ([0, 1, 1, 2, 4, 4], [12, 37, 62, 87])
    """
    wanted = max(round(n_views / VIEWS_OF_A_WHOLE), 1) if n_views >= FEWEST_VIEWS else 0
    n_whole = min(wanted, MOST_WHOLE)
    return ((2 * np.arange(n_whole) + 1) * n_views // max(2 * n_whole, 1)).astype(np.int32)


def _shares(total: int, n: int) -> np.ndarray:
    """Return `n` whole numbers, [n] int64, that differ by at most one and sum to `total`."""
    return np.diff(np.arange(n + 1) * total // max(n, 1))
