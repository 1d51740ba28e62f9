"""Compositing and distortion in torch compared with the float64 loop, the twin and the numba kernels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.reference import composite_ray
from tests.vfr_bake.rendering.test_compositing import REACHES, STEP, intervals, packed
from vfr_bake.rendering import compositing as numba_path
from vfr_bake.torch_kernels.compositing import composite, distortion


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 3e-6)])
def test_it_matches_the_equation(dtype: torch.dtype, tolerance: float, device: torch.device) -> None:
    arguments = packed(dtype)
    sigmas, features, _, starts, counts = arguments
    out, opacity, weights = (a.cpu() for a in composite(*(a.to(device) for a in arguments)))
    for ray, (start, count) in enumerate(zip(starts.tolist(), counts.tolist(), strict=True)):
        rows = slice(start, start + count)
        expected, alpha = composite_ray(sigmas[rows].numpy(), features[rows].numpy(), STEP)
        np.testing.assert_allclose(out[ray].numpy(), expected, rtol=0, atol=tolerance)
        assert opacity[ray].item() == pytest.approx(alpha, abs=tolerance, rel=1e-5)
        assert weights[rows].sum().item() == pytest.approx(alpha, abs=tolerance, rel=1e-5)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_its_gradients_are_the_kernels_on_hard_inputs(dtype: torch.dtype, device: torch.device) -> None:
    gradients = []
    for function, place in ((numba_path.composite, torch.device("cpu")), (composite, device)):
        sigmas, features, *rest = (a.to(place) for a in packed(dtype))
        sigmas.requires_grad_()
        features.requires_grad_()
        outputs = function(sigmas, features, *rest)
        torch.manual_seed(5)
        sum((out * torch.randn(out.shape, dtype=dtype).to(place)).sum() for out in outputs).backward()
        gradients.append((sigmas.grad.cpu(), features.grad.cpu()))
    tolerance = 1e-12 if dtype == torch.float64 else 3e-5
    for ours, expected in zip(*reversed(gradients), strict=True):
        assert torch.isfinite(ours).all()
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=tolerance)


def test_thin_samples_are_not_lost_behind_another_rays_dense_ones(device: torch.device) -> None:
    """Thin samples count even behind another ray's dense ones: a sum over all rays would lose them."""
    n = 10_000
    sigmas = torch.cat([torch.full((100,), 3e6), torch.full((n,), 1e-9)]).to(device)
    starts, counts = torch.tensor([0, 100], device=device), torch.tensor([100, n], device=device)
    ones = torch.ones(100 + n, device=device)
    out, opacity, _ = composite(sigmas, ones[:, None], ones, starts, counts)
    assert opacity[1].item() == pytest.approx(1e-5, rel=1e-3)
    assert out[1, 0].item() == pytest.approx(1e-5, rel=1e-3)


def test_rays_may_be_out_of_order_or_absent(device: torch.device) -> None:
    sigmas, features, deltas, starts, counts = (a.to(device) for a in packed(torch.float64))
    forth = composite(sigmas, features, deltas, starts, counts)
    back = composite(sigmas, features, deltas, starts.flip(0), counts.flip(0))
    torch.testing.assert_close(back[0].flip(0), forth[0], rtol=0, atol=1e-14)
    torch.testing.assert_close(back[2], forth[2], rtol=0, atol=0)
    none = composite(sigmas[:0], features[:0], deltas[:0], starts[:0], counts[:0])
    assert [a.shape for a in none] == [(0, 5), (0,), (0,)]
    empty = composite(sigmas[:0], features[:0], deltas[:0], starts[:2] * 0, counts[:2] * 0)
    assert empty[0].shape == (2, 5) and not empty[1].any()


@pytest.mark.parametrize("reach", REACHES)
@pytest.mark.parametrize("counts", [[5, 0, 1, 12], [1], [0, 0], []])
def test_distortion_and_its_gradient_are_the_kernels(
    counts: list[int], reach: float, device: torch.device
) -> None:
    if sum(counts):
        mids, widths, starts, lengths = intervals(counts)
    else:
        mids = widths = torch.zeros(0, dtype=torch.float64)
        starts = lengths = torch.zeros(len(counts), dtype=torch.int64)
    torch.manual_seed(2)
    weights = torch.rand(len(mids), dtype=torch.float64, requires_grad=True)
    scale = torch.rand(len(counts), dtype=torch.float64)
    expected = numba_path.distortion(weights, mids, widths, reach, starts, lengths)
    (gradient,) = torch.autograd.grad((expected * scale).sum(), weights)
    ours = weights.detach().to(device).requires_grad_()
    mids, widths, starts, lengths = (a.to(device) for a in (mids, widths, starts, lengths))
    losses = distortion(ours, mids, widths, reach, starts, lengths)
    (losses * scale.to(device)).sum().backward()
    torch.testing.assert_close(losses.detach().cpu(), expected.detach(), rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(ours.grad.cpu(), gradient, rtol=1e-12, atol=1e-14)
