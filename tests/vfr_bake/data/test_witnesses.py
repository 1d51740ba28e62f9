"""Pixels that are kept from training: how many, where, and always the same ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.witnesses import (
    MOST_OF_A_VIEW,
    N_WITNESSES,
    PATCH,
    choose_witnesses,
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
    assert in_patches.max() - in_patches.min() <= 1, "as many of every view"
    wanted = N_WITNESSES // 2 if len(whole) else N_WITNESSES
    size = math.isqrt(int(MOST_OF_A_VIEW * 300 * 260))
    assert in_patches.sum() == min(wanted, size**2 * len(learned))
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


@pytest.mark.parametrize(("width", "height"), [(400, 300), (300, 400), (1000, 1100), (90, 91), (3, 200)])
def test_patches_are_squares_anywhere_in_the_picture(width: int, height: int) -> None:
    """A patch has at most a fiftieth of the picture. Its witnesses are spread evenly, and say where it is."""
    views = numbered_views(100, width, height)
    chosen = choose_witnesses(views)
    all_patches, of_views = chosen.patches(views.cameras), chosen.of_views()
    size = min(PATCH, math.isqrt(int(MOST_OF_A_VIEW * width * height)), width)
    corners = []
    for view in chosen.learned():
        rows, columns = np.divmod(all_patches[view], width)
        assert len(rows) == size**2 and np.ptp(rows) == np.ptp(columns) == size - 1
        assert np.isin(of_views[view], all_patches[view]).all()
        counts = np.histogram(np.searchsorted(all_patches[view], of_views[view]), 4, (0, size**2))[0]
        assert np.ptp(counts) <= 3
        corners.append((rows[0] / max(height - size, 1), columns[0] / max(width - size, 1)))
    assert not any(len(all_patches[view]) for view in chosen.whole)
    for along in np.array(corners).T[: 2 if width > size else 1]:
        assert along.min() < 0.1 and along.max() > 0.9 and 0.35 < along.mean() < 0.65


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
