"""Lots of pixels by detail, compared with a naive loop; plain, transparent and one-pixel pictures."""

from __future__ import annotations

import numpy as np
import pytest

from vfr_bake.training.detail import MEAN_LOTS, MIX, POWER, WINDOW, detail_lots


def naive_lots(rgba: np.ndarray) -> np.ndarray:
    """Return the lots [height, width] float64, not rounded, by loops over pixels."""
    height, width = rgba.shape[:2]
    colours = rgba.astype(float) / 255
    colours[..., :3] *= colours[..., 3:]
    differences = np.zeros((height, width))
    for row, column in np.ndindex(height, width):
        for y, x in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            if 0 <= y < height and 0 <= x < width:
                differences[row, column] += ((colours[row, column] - colours[y, x]) ** 2).sum()
    powers = np.zeros((height, width))
    reach = range(-(WINDOW // 2), WINDOW // 2 + 1)
    for row, column in np.ndindex(height, width):
        around = [
            differences[np.clip(row + i, 0, height - 1), np.clip(column + j, 0, width - 1)]
            for i in reach
            for j in reach
        ]
        powers[row, column] = np.mean(around) ** POWER
    matter = rgba[..., 3] > 0
    return np.where(matter, MEAN_LOTS * (MIX + (1 - MIX) * powers / powers[matter].mean()), MEAN_LOTS)


@pytest.mark.parametrize("size", [(9, 7), (1, 5), (2, 1), (16, 16)])
def test_lots_are_those_of_a_naive_loop(size: tuple[int, int]) -> None:
    random = np.random.default_rng(1)
    rgba = random.integers(0, 256, (*size, 4), np.uint8)
    rgba[: size[0] // 2] = rgba[0, 0]  # a plain part
    rgba[-1, :2, 3] = 0
    rgba[0, -1] = 255
    # The lots are rounded to whole numbers, and computed in float32.
    np.testing.assert_allclose(detail_lots(rgba), np.clip(naive_lots(rgba), 1, 255), atol=0.501, rtol=1e-4)


def test_plain_pictures_are_drawn_alike_everywhere() -> None:
    for shape in ((1, 1), (5, 8)):
        assert (detail_lots(np.full((*shape, 4), 77, np.uint8)) == MEAN_LOTS).all()


def test_what_is_transparent_is_drawn_as_often_as_the_mean_whatever_its_colours_are() -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (32, 32, 4), np.uint8)
    rgba[..., 3] = 0
    assert (detail_lots(rgba) == MEAN_LOTS).all()
    rgba[:16, :16] = 255
    lots = detail_lots(rgba)
    matter = rgba[..., 3] == 255
    assert (lots[~matter] == MEAN_LOTS).all() and abs(lots[matter].mean() - MEAN_LOTS) < 0.5
    assert lots[5, 5] == round(MIX * MEAN_LOTS) and lots[15, 5] > 3 * MEAN_LOTS
