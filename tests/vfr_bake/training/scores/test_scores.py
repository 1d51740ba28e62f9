"""SSIM compared with a naive loop, the scores of views that are made of it, and pictures side by side."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from player.errors import MissingExtraError, ShapeError
from vfr_bake.training.scores.metrics import (
    BRIGHTEST_ERROR,
    ViewScore,
    comparison,
    mean_scores,
    psnr,
    score_view,
    ssim,
)

FLOAT32 = 1e-5
"""Tolerance for float32. SSIM's variances are differences of numbers near 1, beside a constant of 9e-4, so
that a window is off by 1e-7 / 9e-4, and the mean by less."""


def naive_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Evaluate equations 6 and 12 to 16 of Wang et al. 2004, one window after the other, in float64."""
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    c1, c2 = 0.01**2, 0.03**2
    values = []
    for channel in range(3):
        for row in range(a.shape[0] - 10):
            for column in range(a.shape[1] - 10):
                x = a[row : row + 11, column : column + 11, channel].astype(np.float64)
                y = b[row : row + 11, column : column + 11, channel].astype(np.float64)
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                vxy = (window * (x - mx) * (y - my)).sum()
                values.append((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    return float(np.mean(values))


def pictures(shape: tuple[int, int], noise: float, dtype: type) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    a = rng.random((*shape, 3))
    b = np.clip(a + rng.normal(0, noise, a.shape), 0, 1)
    return a.astype(dtype), b.astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("noise", [1e-3, 0.1, 0.5])
@pytest.mark.parametrize("shape", [(11, 11), (11, 20), (23, 17)])
def test_ssim_is_the_naive_loop(shape: tuple[int, int], noise: float, dtype: type) -> None:
    a, b = pictures(shape, noise, dtype)
    assert ssim(a, b) == pytest.approx(naive_ssim(a, b), abs=FLOAT32)
    assert ssim(a, b) == pytest.approx(ssim(b, a), abs=FLOAT32)


@pytest.mark.parametrize("levels", [(0, 0), (1, 1), (0, 1), (0.9, 0.7), (1e-40, 0)])
def test_ssim_of_constant_pictures_is_that_of_their_means(levels: tuple[float, float]) -> None:
    m, n = levels
    expected = (2 * m * n + 1e-4) / (m * m + n * n + 1e-4)
    a, b = np.full((16, 13, 3), m), np.full((16, 13, 3), n)
    assert ssim(a, b) == pytest.approx(expected, abs=FLOAT32)


def test_ssim_of_a_negative_is_negative() -> None:
    a, _ = pictures((24, 24), 0, np.float64)
    assert ssim(a, 1 - a) < -0.5


@pytest.mark.parametrize("shape", [(7, 7, 3), (10, 40, 3), (40, 10, 3), (0, 0, 3), (16, 16), (16, 16, 4)])
def test_ssim_needs_a_whole_window_of_colours(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match=r"ssim: expected \[height, width, 3\] of at least 11 x 11 pixels"):
        ssim(np.zeros(shape), np.zeros(shape))


@pytest.mark.parametrize("measure", [psnr, ssim, comparison])
def test_pictures_of_two_sizes_are_refused(measure) -> None:
    with pytest.raises(ShapeError, match=r"\[16, 16, 3\] and \[1, 16, 3\]"):
        measure(np.zeros((16, 16, 3)), np.zeros((1, 16, 3)))


def test_ssim_without_scikit_image_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skimage.metrics", None)
    with pytest.raises(MissingExtraError, match="scikit-image: pip install"):
        ssim(np.zeros((16, 16, 3)), np.zeros((16, 16, 3)))


def test_scores_before_and_after_rounding() -> None:
    grey = np.full((16, 16, 3), 100 / 255)
    within = score_view("a", grey, grey + 0.4 / 255)
    assert within.psnr == float("inf") and within.ssim == 1
    assert within.psnr_float == pytest.approx(20 * np.log10(255 / 0.4))
    across = score_view("a", grey, grey + 0.6 / 255)
    assert across.psnr == pytest.approx(20 * np.log10(255))
    assert across.psnr_float == pytest.approx(20 * np.log10(255 / 0.6))
    assert across.ssim < across.ssim_float < 1 + FLOAT32


def test_lpips_is_of_the_rounded_pictures() -> None:
    def largest(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.abs(a - b).max())

    grey = np.full((16, 16, 3), 100 / 255)
    assert score_view("a", grey, grey + 0.4 / 255, largest).lpips == 0
    assert score_view("a", grey, grey + 0.6 / 255, largest).lpips == pytest.approx(1 / 255)


def test_the_mean_of_an_infinite_psnr_is_infinite() -> None:
    scores = [ViewScore("a", float("inf"), 1, 50, 1, 0.0), ViewScore("b", 30, 0.5, 30, 0.5, 0.5)]
    means = mean_scores(scores)
    assert means == {"psnr": float("inf"), "ssim": 0.75, "psnr_float": 40, "ssim_float": 0.75, "lpips": 0.25}


def test_side_by_side() -> None:
    photograph, rgb = np.full((4, 5, 3), 0.2), np.full((4, 5, 3), 0.2)
    rgb[1, 2, 1] += BRIGHTEST_ERROR
    rgb[3, 4] -= 0.2 * BRIGHTEST_ERROR
    out = comparison(photograph, rgb)
    assert out.dtype == np.uint8 and out.shape == (4, 15, 3)
    assert np.all(out[:, :5] == 51) and out[1, 7].tolist() == [51, 115, 51]
    errors = out[:, 10:]
    assert errors[1, 2].tolist() == [255, 255, 255] and errors[3, 4].tolist() == [153, 0, 0]
    assert np.count_nonzero(errors.any(axis=2)) == 2
