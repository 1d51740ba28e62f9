"""Gains and offsets of pictures: least squares as in numpy, used only if they hold on the other half."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from player.errors import FormatError
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.training.captures.exposure import (
    PRIOR_PIXELS,
    Correction,
    fit,
    gain_on_other_half,
    products,
    squared_error,
)
from vfr_bake.training.captures.picture_colours import (
    PictureColours,
    colours_content,
    fitted,
    restore_colours,
)


def some_pixels(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours times opacity, opacity, and what photographs show of these, with a little noise."""
    random = np.random.default_rng(seed)
    opacity = random.uniform(0, 1, n)
    colours = random.uniform(0, 1, (n, 3)) * opacity[:, None]
    wanted = colours * [1.2, 0.9, 0.5] + opacity[:, None] * [0.1, -0.05, 0] + random.normal(0, 0.01, (n, 3))
    return colours, opacity, wanted


def test_it_is_the_least_squares_fit_with_the_prior_pixels() -> None:
    colours, opacity, wanted = some_pixels(200)
    found = fit(products(*map(torch.from_numpy, (colours, opacity, wanted))).sum(dim=0))
    black, white = np.sqrt(PRIOR_PIXELS) * np.array([[[0.0, 1.0]], [[1.0, 1.0]]])
    for channel in range(3):
        rows = np.concatenate([np.stack([colours[:, channel], opacity], axis=1), black, white])
        values = np.concatenate([wanted[:, channel], [0.0, np.sqrt(PRIOR_PIXELS)]])
        oracle, *_ = np.linalg.lstsq(rows, values, rcond=None)
        np.testing.assert_allclose([found.gains[channel], found.offsets[channel]], oracle, rtol=1e-9)


def test_the_sums_give_the_squared_error() -> None:
    colours, opacity, wanted = some_pixels(50)
    correction = Correction(torch.tensor([1.1, 0.9, 0.7]), torch.tensor([0.1, 0.0, -0.1]))
    shown = colours * correction.gains.numpy() + opacity[:, None] * correction.offsets.numpy()
    sums = products(*map(torch.from_numpy, (colours, opacity, wanted))).sum(dim=0)
    oracle = ((shown - wanted) ** 2).sum(axis=0)
    np.testing.assert_allclose(squared_error(sums, correction).numpy(), oracle, rtol=1e-5)


def test_a_picture_without_pixels_needs_no_correction() -> None:
    found = fit(torch.zeros(2, 3, 6, dtype=torch.float64))
    assert torch.equal(found.gains, torch.ones(2, 3, dtype=torch.float64))
    assert not found.offsets.any()


@pytest.mark.parametrize("seed", range(5))
def test_only_gains_that_hold_on_the_other_half_pay(seed: int) -> None:
    """Gains that differ by 10 % pay on the other half; noise of a hundred pixels in each half does not."""
    generator = torch.Generator().manual_seed(seed)
    colours = torch.rand(20, 2, 100, 3, generator=generator)
    noise = 0.05 * torch.randn(20, 2, 100, 3, generator=generator)
    gains = 1 + 0.1 * torch.randn(20, 1, 1, 1, generator=generator)

    def gain(wanted: torch.Tensor) -> float:
        pixels = (colours.reshape(-1, 3), torch.ones(4000), wanted.reshape(-1, 3))
        return gain_on_other_half(products(*pixels).view(20, 2, 100, 3, 6).sum(dim=2))

    assert gain(colours + noise) < 0.05
    assert gain(colours * 0.8 + noise) < 0.05, "all pictures alike: the field itself learns that"
    assert gain(colours * gains + noise) > 1.0
    assert gain_on_other_half(torch.zeros(2, 2, 3, 6, dtype=torch.float64)) == 0


def test_the_mean_picture_is_neutral() -> None:
    generator = torch.Generator().manual_seed(0)
    found = Correction(1 + 0.3 * torch.rand(9, 3, generator=generator), torch.rand(9, 3, generator=generator))
    neutral = found.neutral()
    torch.testing.assert_close(neutral.gains.mean(dim=0), torch.ones(3))
    torch.testing.assert_close(neutral.offsets.mean(dim=0), torch.zeros(3), atol=1e-6, rtol=0)
    # Applied after the mean correction, the neutral correction gives the same colours as the fitted one.
    colours = torch.rand(9, 3, generator=generator)
    corrected = colours * found.gains.mean(dim=0) + found.offsets.mean(dim=0)
    torch.testing.assert_close(
        corrected * neutral.gains + neutral.offsets, colours * found.gains + found.offsets
    )


def test_a_photograph_is_fitted_without_its_background() -> None:
    colours, opacity, _ = some_pixels(20_000)
    straight = colours / opacity[:, None] * 0.5 + 0.2
    rgba = np.concatenate([255 * straight, 255 * opacity[:, None]], axis=1).round().astype(np.uint8)
    gains, offsets = fitted(colours.astype(np.float32), opacity.astype(np.float32), rgba)
    np.testing.assert_allclose(gains, 0.5, atol=0.02)
    np.testing.assert_allclose(offsets, 0.2, atol=0.02)


def test_witnesses_get_the_colours_that_the_field_has() -> None:
    gains, offsets = (
        np.array([[0.5] * 3, [2.0] * 3], np.float32),
        np.array([[0.0] * 3, [0.1] * 3], np.float32),
    )
    neutral = np.array([[100, 50, 7, 255], [100, 50, 7, 128], [40, 30, 20, 255]], np.uint8)
    shown = neutral.copy()
    views = np.array([0, 1, 1])
    shown[:, :3] = (neutral[:, :3] * gains[views] + 255 * offsets[views]).round()
    witnesses = Witnesses(np.array([1, 2]), np.array([3, 0, 1]), shown, np.array([1]))
    found = PictureColours(gains, offsets).neutral(witnesses)
    assert np.abs(found.rgba.astype(int) - neutral).max() <= 1  # half a level over a gain of 0.5
    assert np.array_equal(found.counts, witnesses.counts) and np.array_equal(found.pixels, witnesses.pixels)


def content(**values: object) -> dict:
    return {"gains": torch.ones(2, 3), "offsets": torch.zeros(2, 3)} | values


def test_what_is_kept_comes_back() -> None:
    random = np.random.default_rng(0)
    colours = PictureColours(*(random.uniform(0.5, 1.5, (4, 3)).astype(np.float32) for _ in range(2)))
    again = restore_colours(colours_content(colours), 4, "m.pt: exposure")
    assert np.array_equal(again.gains, colours.gains) and np.array_equal(again.offsets, colours.offsets)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (None, "expected dict, got NoneType"),
        ({}, "gains: expected Tensor, got NoneType"),
        (content(gains=torch.ones(2, 3).double()), "gains: expected a plain tensor of 32-bit floats"),
        (content(offsets=torch.zeros(2, 3).to_sparse()), "offsets: expected a plain tensor"),
        (content(gains=torch.ones(3, 3)), r"gains: expected \[2, 3\], got \[3, 3\]"),
        (content(gains=torch.zeros(2, 3)), "gains: expected numbers from 0.01 to 100.0"),
        (content(offsets=torch.full((2, 3), float("nan"))), "offsets: expected numbers from -2.0 to 2.0"),
    ],
)
def test_what_is_no_colours_is_refused(bad: object, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        restore_colours(bad, 2, "m.pt: exposure")
