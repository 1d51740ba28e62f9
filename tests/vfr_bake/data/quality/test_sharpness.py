"""Blurred pictures are found among sharp ones, whatever the subject, and none where all are alike."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image, ImageFilter

from player.errors import ShapeError
from vfr_bake.data.demo import demo_views
from vfr_bake.data.quality.sharpness import FEWEST, SMALLEST, blur, blurred, without_blurred
from vfr_bake.data.store.capture import PosedImages


@pytest.fixture(scope="module")
def views() -> PosedImages:
    return demo_views(size=128, n_train=16, n_test=0)[0]


def out_of_focus(image: np.ndarray, radius: float) -> np.ndarray:
    return np.asarray(Image.fromarray(image).filter(ImageFilter.GaussianBlur(radius)))


def shaken(image: np.ndarray, n: int, axis: int) -> np.ndarray:
    """Return a picture as if it moved by `n` pixels during the exposure."""
    moved = [np.roll(image.astype(np.float64), shift, axis) for shift in range(n)]
    return np.mean(moved, axis=0).astype(np.uint8)


def test_sharp_pictures_stay(views: PosedImages) -> None:
    kept, names = without_blurred(views)
    assert names == [] and len(kept.images) == 16


def test_blurred_pictures_are_named_and_left_out(views: PosedImages) -> None:
    images = list(views.images)
    images[2] = out_of_focus(images[2], 2.5)
    images[7] = shaken(images[7], 12, axis=1)
    images[11] = shaken(images[11], 12, axis=0)
    kept, names = without_blurred(PosedImages(views.cameras, images))
    assert names == [views.cameras[number].name for number in (2, 7, 11)]
    assert len(kept.images) == 13 and kept.images[2] is images[3]


def test_more_blur_is_more(views: PosedImages) -> None:
    values = [blur(out_of_focus(views.images[3], radius)) for radius in (0, 1, 2, 4)]
    assert values == sorted(values) and values[0] + 0.2 < values[-1] <= 1


def test_large_pictures_are_measured_at_one_size(views: PosedImages) -> None:
    """Large pictures are measured as if 512 pixels wide: repeating pixels 4 x 4 times changes nothing."""
    small = np.asarray(Image.fromarray(views.images[0]).resize((512, 512), Image.Resampling.BICUBIC))
    large = small.repeat(4, axis=0).repeat(4, axis=1)
    assert blur(large) == pytest.approx(blur(small), abs=1e-4)


def test_what_tells_nothing_is_not_blurred() -> None:
    assert blur(np.full((100, 100, 3), 7, np.uint8)) == 0
    assert blur(np.zeros((SMALLEST - 1, 400, 4), np.uint8)) == 0
    assert blurred([0.9] * (FEWEST - 2) + [0.1]) == []
    assert blurred([0.9] * (2 * FEWEST)) == []
    with pytest.raises(ShapeError, match=r"expected \[height, width, 3 or 4\] uint8"):
        blur(np.zeros((64, 64), np.uint8))
