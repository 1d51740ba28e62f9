"""Specks in synthetic pictures, as a benchmark counts them: which pixels are specks, and which are not."""

from __future__ import annotations

import numpy as np
import pytest

from player.errors import ShapeError
from tests.benchmarks.bench_specks import speck_mask


def median_by_hand(picture: np.ndarray, y: int, x: int, channel: int) -> float:
    """Return the median of the nine values around a pixel; the nearest pixel stands for one outside."""
    height, width = picture.shape[:2]
    nine = [
        picture[min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1), channel]
        for dy in (-1, 0, 1)
        for dx in (-1, 0, 1)
    ]
    return sorted(nine)[4]


def test_every_pixel_by_hand() -> None:
    random = np.random.default_rng(0)
    wanted = random.random((9, 7, 3)) * 0.2
    picture = wanted + random.random((9, 7, 3)) * 0.3
    expected = np.zeros((9, 7), bool)
    for y, x, channel in np.ndindex(9, 7, 3):
        apart = abs(picture[y, x, channel] - median_by_hand(picture, y, x, channel))
        calm = abs(wanted[y, x, channel] - median_by_hand(wanted, y, x, channel))
        expected[y, x] |= apart > 0.1 and calm <= 0.05
    assert 0 < expected.sum() < expected.size
    assert np.array_equal(speck_mask(picture, wanted, 0.1), expected)


def test_specks_count_where_they_are_and_in_any_channel() -> None:
    wanted = np.full((20, 30, 3), 0.1)
    picture = wanted.copy()
    places = [(0, 0), (19, 29), (5, 7), (5, 20)]
    for number, (y, x) in enumerate(places):
        picture[y, x, number % 3] += 0.101
    # at a corner the repeated border shows the corner's own pixel in four of the nine places
    assert {tuple(place) for place in np.argwhere(speck_mask(picture, wanted, 0.1)).tolist()} == set(places)
    assert not speck_mask(picture, wanted, 0.11).any(), "below the threshold"
    assert not speck_mask(wanted, picture, 0.1).any(), "what is missing in the picture is calm there"


def test_wires_highlights_edges_and_patches_do_not_count() -> None:
    wanted = np.ones((20, 20, 3))
    wanted[:, 5] = 0  # a wire
    wanted[3, 12] = 0  # a highlight, or a dot
    wanted[10:, 8:] = 0.3  # edges and a corner
    assert not speck_mask(wanted, wanted, 0.1).any()
    shifted = wanted.copy()
    shifted[9:, 7:] = 0.3  # edges moved by a pixel: wrong, but no specks except at their corner
    assert np.argwhere(speck_mask(shifted, wanted, 0.1)[6:, 7:]).tolist() == [[3, 0]]
    broken = wanted.copy()
    broken[10, 5] = 1  # a hole in the wire: white, as is the median of the nine pixels there
    assert not speck_mask(broken, wanted, 0.1)[10, 5]
    patch = wanted.copy()
    patch[14:18, 13:17] = 0.9
    assert not speck_mask(patch, wanted, 0.1)[14:18, 13:17][1:-1, 1:-1].any()


def test_pictures_of_two_sizes() -> None:
    with pytest.raises(ShapeError, match="specks: expected two pictures"):
        speck_mask(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)), 0.1)
