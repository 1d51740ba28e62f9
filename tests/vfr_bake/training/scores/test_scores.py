"""SSIM compared with a naive loop, the scores of views that are made of it, and pictures side by side."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace

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


def naive_ssim(a: np.ndarray, b: np.ndarray, seen: np.ndarray | None = None) -> float:
    """Evaluate equations 6 and 12 to 16 of Wang et al. 2004, one window after the other, in float64; only
    windows whose middle is `seen`."""
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    c1, c2 = 0.01**2, 0.03**2
    values = []
    for channel in range(3):
        for row in range(a.shape[0] - 10):
            for column in range(a.shape[1] - 10):
                if seen is not None and not seen[row + 5, column + 5]:
                    continue
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
    similarity = ssim(a, 1 - a)
    assert similarity is not None and similarity < -0.5


@pytest.mark.parametrize("shape", [(16, 16), (16, 16, 4)])
def test_ssim_needs_colours(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match=r"ssim: expected \[height, width, 3\], got"):
        ssim(np.zeros(shape), np.zeros(shape))


@pytest.mark.parametrize("shape", [(7, 7), (10, 40), (40, 10), (0, 0)])
def test_pictures_smaller_than_a_window_have_no_ssim(shape: tuple[int, int]) -> None:
    assert ssim(np.zeros((*shape, 3)), np.zeros((*shape, 3))) is None


def test_a_tiny_view_has_a_psnr_and_no_ssim() -> None:
    a, b = pictures((8, 9), 0.1, np.float32)
    score = score_view("a", a, b)
    assert 10 < score.psnr_float < 30 and score.ssim is None and score.ssim_float is None
    assert mean_scores([score, replace(score, ssim=0.5)])["ssim"] is None


def test_masked_pixels_count_in_no_score() -> None:
    """Half of the view is masked and equal to the render there. Its scores are those of the other half; LPIPS
    cannot leave pixels out."""
    a, b = pictures((24, 30), 0.1, np.float32)
    seen = np.repeat(np.arange(30)[None] < 15, 24, axis=0)
    b[~seen] = a[~seen]
    score = score_view("a", a, b, lambda *_: 0.5, seen)
    assert score.psnr_float == pytest.approx(psnr(a[:, :15], b[:, :15]), abs=1e-9)
    assert score.ssim_float == pytest.approx(naive_ssim(a, b, seen), abs=FLOAT32)
    whole = ssim(a, b)
    assert score.ssim_float is not None and whole is not None and score.ssim_float < whole - 0.005
    assert score.lpips is None
    assert score_view("a", a, b, lambda *_: 0.5, np.ones_like(seen)).lpips == 0.5, "nothing is masked"
    border = np.zeros_like(seen)
    border[:4] = True  # no window lies around these pixels
    assert score_view("a", a, b, seen=border).ssim is None


def test_large_pictures_are_compared_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = pictures((41, 17), 0.1, np.float32)
    seen = np.random.default_rng(1).random((41, 17)) < 0.5
    whole = score_view("a", a, b), score_view("a", a, b, seen=seen)
    monkeypatch.setattr("vfr_bake.training.scores.metrics.VALUES_AT_ONCE", 3 * 17 * 7)
    for first, again in zip(whole, (score_view("a", a, b), score_view("a", a, b, seen=seen)), strict=True):
        assert asdict(again) == pytest.approx(asdict(first), abs=1e-9)


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
    assert across.ssim is not None and across.ssim_float is not None
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
