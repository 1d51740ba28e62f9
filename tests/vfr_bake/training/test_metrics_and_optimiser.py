"""PSNR, pictures over backgrounds, Adam on the table and the schedule."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vfr_bake.training.metrics import over_background, psnr, to_8_bit
from vfr_bake.training.optimiser import GridAdam, rate_factor


def test_psnr_of_known_errors() -> None:
    black = np.zeros((4, 4, 3))
    assert psnr(black, black) == float("inf")
    assert psnr(black, black + 0.01) == pytest.approx(40)
    assert psnr(black, black + 1) == pytest.approx(0)


def test_eight_bits_round_to_nearest() -> None:
    levels = np.arange(256) / 255
    assert np.array_equal(to_8_bit(levels), np.arange(256))
    assert to_8_bit(np.array([-1.0, 2.0, 0.4999 / 255, 0.5001 / 255])).tolist() == [0, 255, 0, 1]


def test_alpha_blends_over_the_background() -> None:
    rgba = np.array([[255, 0, 0, 0], [255, 0, 0, 255], [0, 0, 0, 51]], np.uint8)
    out = over_background(rgba, np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(out, [[0, 0.5, 1], [1, 0, 0], [0, 0.4, 0.8]], atol=1e-6)


def test_grid_adam_is_adam_where_there_is_a_gradient() -> None:
    torch.manual_seed(0)
    start = torch.randn(6, 2)
    ours, theirs = torch.nn.Parameter(start.clone()), torch.nn.Parameter(start.clone())
    adam, reference = GridAdam(ours), torch.optim.Adam([theirs], lr=0.1, betas=(0.9, 0.99), eps=1e-15)
    for _ in range(5):
        gradient = torch.randn(6, 2)
        gradient[3] = 0
        ours.grad.copy_(gradient)
        theirs.grad = gradient.clone()
        adam.step(0.1)
        reference.step()
    rows = [0, 1, 2, 4, 5]
    torch.testing.assert_close(ours[rows], theirs[rows], rtol=1e-5, atol=1e-6)
    assert torch.equal(ours[3], start[3]), "no gradient, no change"
    assert not ours.grad.any(), "the gradient is cleared"


def test_schedule_warms_up_and_steps_down() -> None:
    assert rate_factor(50, 0.01) == pytest.approx(0.505)
    assert [round(rate_factor(1000, p), 6) for p in (0.49, 0.5, 0.75, 0.9)] == [1, 0.33, 0.1089, 0.035937]
