"""Pixels that a model keeps for a bake to learn from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from tests.vfr_bake.data.test_witnesses import numbered_views
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.view_pixels import N_TRAINING_PIXELS, NEAR, choose_training_pixels
from vfr_bake.data.witnesses import choose_witnesses

NOTHING = [np.zeros(0, np.int64)] * 2
"""No pixels of two views are set apart."""


def opaque(views: PosedImages) -> PosedImages:
    return replace(views, images=[image | np.array([0, 0, 0, 255], np.uint8) for image in views.images])


def test_training_pixels_are_those_of_learned_views_but_for_witnesses() -> None:
    views = opaque(numbered_views(24, 600, 520))
    witnesses = choose_witnesses(views)
    chosen = choose_training_pixels(views, witnesses.patches(views.cameras), witnesses.learned())
    counts = chosen.counts[witnesses.learned()]
    assert not chosen.counts[witnesses.whole].any() and len(witnesses.whole)
    most = N_TRAINING_PIXELS // len(counts)
    assert (counts <= most).all() and (counts > 0.95 * most).all(), "alike many of every view"
    assert chosen.counts.sum() == len(chosen.pixels) <= N_TRAINING_PIXELS
    for kept, patch in zip(chosen.of_views(), witnesses.patches(views.cameras), strict=True):
        assert len(np.unique(kept)) == len(kept) and not len(np.intersect1d(kept, patch))
    rgba = chosen.rgba.astype(np.int64)
    assert np.array_equal(rgba[:, 0] + 256 * rgba[:, 1] + 65536 * rgba[:, 2], chosen.pixels)
    again = choose_training_pixels(views, witnesses.patches(views.cameras), witnesses.learned())
    assert np.array_equal(again.pixels, chosen.pixels)


def test_a_small_scene_keeps_every_pixel_but_its_witnesses() -> None:
    views = opaque(numbered_views(3, 40, 30))
    witnesses = choose_witnesses(views)
    chosen = choose_training_pixels(views, witnesses.patches(views.cameras), witnesses.learned())
    assert len(chosen.pixels) + len(witnesses.pixels) == 3 * 40 * 30 and len(witnesses.pixels)


@pytest.mark.parametrize("at", [(0, 0), (29, 99), (15, 50), (29, 3)])
def test_of_a_transparent_view_only_what_is_near_something_is_kept(at: tuple[int, int]) -> None:
    views = opaque(numbered_views(2, 100, 30))
    alpha = np.zeros((30, 100), np.uint8)
    alpha[at] = 1
    views.images[1][..., 3] = alpha
    radius = round(100 * NEAR)
    around = binary_dilation(alpha, np.ones((2 * radius + 1, 2 * radius + 1)))
    chosen = choose_training_pixels(views, NOTHING, np.array([1]))
    assert np.array_equal(chosen.pixels, np.flatnonzero(around)) and chosen.counts.tolist() == [
        0,
        around.sum(),
    ]


def test_a_view_of_nothing_keeps_nothing() -> None:
    views = opaque(numbered_views(2, 10, 10))
    views.images[0][..., 3] = 0
    assert choose_training_pixels(views, NOTHING, np.array([0, 1])).counts.tolist() == [0, 100]
