"""Pixels that are kept from training: how many, where, and always the same ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from vfr_bake.data.capture import PosedImages
from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.witnesses import (
    MOST_OF_A_VIEW,
    N_WITNESSES,
    PATCH,
    choose_witnesses,
    patches,
    whole_views,
)


def numbered_views(n_views: int, width: int, height: int) -> PosedImages:
    """Return views whose pixels' colours are their numbers, and whose alpha is the view's number."""
    cameras = [
        replace(camera, width=width, height=height, cx=width / 2, cy=height / 2)
        for camera in demo_cameras(8, n_views)
    ]
    numbers = np.arange(width * height)
    images = [
        np.stack([numbers % 256, numbers // 256 % 256, numbers // 65536, np.full_like(numbers, view)], -1)
        .astype(np.uint8)
        .reshape(height, width, 4)
        for view in range(n_views)
    ]
    return PosedImages(cameras, images)


@pytest.mark.parametrize("n_views", [2, 19, 20, 44, 100])
def test_witnesses_are_spread_over_all_views(n_views: int) -> None:
    views = numbered_views(n_views, 300, 260)
    chosen = choose_witnesses(views)
    whole, learned = chosen.whole, chosen.learned()
    assert sorted([*whole, *learned]) == list(range(n_views))
    assert len(whole) == {2: 0, 19: 0, 20: 1, 44: 2, 100: 4}[n_views]
    in_patches = chosen.counts[learned]
    assert in_patches.max() <= 1.2 * in_patches.min(), "about as many of every view"
    wanted = N_WITNESSES // 2 if len(whole) else N_WITNESSES
    allowed = int(MOST_OF_A_VIEW * 300 * 260) * len(learned)
    assert 0.8 * min(wanted, allowed) < in_patches.sum() <= min(wanted, allowed)
    assert chosen.counts[whole].sum() == (N_WITNESSES // 2 if len(whole) else 0)
    assert chosen.counts.sum() == len(chosen.pixels) == len(chosen.rgba) <= N_WITNESSES


def test_colours_are_those_of_the_pixels_and_no_pixel_comes_twice() -> None:
    chosen = choose_witnesses(numbered_views(24, 300, 260))
    views = chosen.views()
    assert np.array_equal(chosen.rgba[:, 3], views)
    rgba = chosen.rgba.astype(np.int64)
    assert np.array_equal(rgba[:, 0] + 256 * rgba[:, 1] + 65536 * rgba[:, 2], chosen.pixels)
    assert len(np.unique(views * 10**6 + chosen.pixels)) == len(chosen.pixels)
    for view in range(24):
        pixels = chosen.pixels[views == view]
        assert (np.diff(pixels) > 0).all() and pixels.min() >= 0 and pixels.max() < 300 * 260


@pytest.mark.parametrize(("width", "height"), [(400, 300), (300, 400), (90, 91)])
def test_patches_are_squares_that_do_not_meet_and_lie_anywhere(width: int, height: int) -> None:
    """Patches are apart; each tenth of rows and columns has about a tenth of them, the outermost fewer."""
    random = np.random.default_rng(3)
    n = 5 * PATCH**2 + 100
    rows_hit, columns_hit = np.zeros(10), np.zeros(10)
    for _ in range(200):
        numbers = patches(n, width, height, random)
        assert (np.diff(numbers) > 0).all() and numbers[0] >= 0 and numbers[-1] < width * height
        rows, columns = np.divmod(numbers, width)
        rows_hit += np.bincount(rows * 10 // height, minlength=10) / len(numbers) / 200
        columns_hit += np.bincount(columns * 10 // width, minlength=10) / len(numbers) / 200
        # A pixel inside a patch has its four neighbours in the patch.
        there = np.isin(numbers + 1, numbers) & np.isin(numbers - 1, numbers)
        there &= np.isin(numbers + width, numbers) & np.isin(numbers - width, numbers)
        size = math.isqrt(len(numbers) // 5)
        assert len(numbers) == 5 * size**2 and abs(size - PATCH) <= 2
        assert there.sum() >= 5 * (size - 2) ** 2
    for hit in (rows_hit, columns_hit):
        assert 0.03 < hit.min() and hit.max() < 0.16


def test_the_same_pictures_have_the_same_witnesses() -> None:
    once, again = (choose_witnesses(numbered_views(21, 30, 20)) for _ in range(2))
    for name in ("counts", "pixels", "rgba", "whole"):
        assert np.array_equal(getattr(once, name), getattr(again, name))


def test_pictures_of_mixed_sizes_and_tiny_ones() -> None:
    views = [numbered_views(20, *size) for size in ((7, 5), (40, 30), (1, 1))]
    mixed = PosedImages(
        [views[i % 3].cameras[i] for i in range(20)], [views[i % 3].images[i] for i in range(20)]
    )
    chosen = choose_witnesses(mixed)
    assert chosen.whole.tolist() == [10] and chosen.counts[10] == 1200
    assert chosen.counts[[0, 1, 2]].tolist() == [0, 16, 0], "a square of a fiftieth of a view at most"
    n_pixels = np.array([camera.width * camera.height for camera in mixed.cameras])
    assert (chosen.pixels < n_pixels[chosen.views()]).all()


def test_there_may_be_none() -> None:
    chosen = choose_witnesses(numbered_views(3, 4, 3))
    assert chosen.counts.tolist() == [0, 0, 0] and len(chosen.pixels) == len(chosen.rgba) == 0


def test_a_large_set_still_keeps_apart_a_few_views_only() -> None:
    assert len(whole_views(100_000)) == 4
