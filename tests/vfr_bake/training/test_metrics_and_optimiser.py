"""PSNR, pictures over backgrounds, Adam on the table and on other tensors, and the schedule."""

from __future__ import annotations

import copy
import subprocess
import sys

import numpy as np
import pytest
import torch

from vfr_bake.config import FieldConfig
from vfr_bake.field.hash_grid import HashGrid
from vfr_bake.training.optimiser import Adam, FusedGridAdam, GridAdam, rate_factor
from vfr_bake.training.scores.metrics import over_background, psnr, to_8_bit


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


def test_adam_is_torchs_and_goes_on_where_it_was() -> None:
    """Adam equals torch's and continues from its state, even if a tensor has no gradient in some steps, as
    the pilot's tensors do once it is done."""
    torch.manual_seed(0)
    start = [torch.randn(7, 5), torch.randn(5), torch.randn(3)]
    ours, theirs = ([tensor.clone().requires_grad_() for tensor in start] for _ in range(2))
    adam, reference = Adam(ours, (0.9, 0.99), 1e-15), torch.optim.Adam(theirs, betas=(0.9, 0.99), eps=1e-15)
    for step in range(6):
        for number, (own, other) in enumerate(zip(ours, theirs, strict=True)):
            own.grad = None if number == step % 4 else torch.randn_like(own)
            other.grad = None if own.grad is None else own.grad.clone()
        if step == 3:
            state = copy.deepcopy(adam.state())
            adam = Adam(ours, (0.9, 0.99), 1e-15)
            adam.restore(state)
        rate = 0.1 / (step + 1)
        reference.param_groups[0]["lr"] = rate
        adam.step(rate)
        reference.step()
    for own, other, before in zip(ours, theirs, start, strict=True):
        torch.testing.assert_close(own, other, rtol=1e-5, atol=1e-6)
        assert not torch.equal(own, before)
    adam.clear()
    assert all(own.grad is None for own in ours)
    adam.step(0.1)  # no gradient anywhere
    with pytest.raises(ValueError, match=r"expected \[3\], got \[7, 5\]"):
        Adam(ours[2:]).restore(Adam(ours[:1]).state())


def test_a_start_does_not_import_torchs_compiler() -> None:
    """A step of the optimiser does not import torch's compiler, which would take three seconds."""
    program = (
        "import sys, torch; from vfr_bake.training.optimiser import Adam; x = torch.ones(2); "
        "x.grad = torch.ones(2); Adam([x]).step(0.1); assert 'torch._dynamo' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_grid_adam_is_adam_where_there_is_a_gradient() -> None:
    torch.manual_seed(0)
    start = torch.randn(6, 2)
    ours, theirs = torch.nn.Parameter(start.clone()), torch.nn.Parameter(start.clone())
    adam, reference = GridAdam(ours), torch.optim.Adam([theirs], lr=0.1, betas=(0.9, 0.95), eps=1e-15)
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


def test_scatter_and_step_in_one_are_the_two_one_after_the_other() -> None:
    config = FieldConfig(n_levels=5, base_resolution=4, max_resolution=40, log2_table_size=10)
    torch.manual_seed(0)
    ours, theirs = HashGrid(config), HashGrid(config)
    theirs.load_state_dict(ours.state_dict())
    fused, plain = FusedGridAdam(ours), GridAdam(theirs.table)
    for n_points in (300, 1, 0, 3000):  # the last one needs more scratch memory than the first
        # Many points lie at one place: their gradients add up in one row, and sometimes to zero.
        points = torch.cat([torch.rand(n_points, 3), torch.full((n_points // 3, 3), 0.37)])
        gradient = torch.randn(len(points), config.n_channels)
        gradient[::7] = 0
        for grid, adam in ((ours, fused), (theirs, plain)):
            grid(points).backward(gradient)
            grid(points[:5]).backward(gradient[:5])
            adam.step(0.01)
    assert torch.equal(ours.table, theirs.table)
    assert torch.equal(fused.moments, plain.moments)
    assert ours.table.grad is None


def test_schedule_warms_up_stays_and_falls_to_nothing() -> None:
    assert rate_factor(50, 0.01) == pytest.approx(0.505)
    assert [round(rate_factor(1000, p), 6) for p in (0.49, 0.5, 0.75, 0.9, 1.0)] == [1, 1, 0.5, 0.2, 0]
