"""Compositing compared with a float64 loop, its torch twin and finite differences, on hard inputs too."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.reference import composite_ray
from tests.vfr_bake import twins
from vfr_bake.field.networks import DensityNetwork
from vfr_bake.kernels.compositing import silence
from vfr_bake.kernels.density import LARGEST_LOGIT
from vfr_bake.rendering.compositing import composite, composite_field, distortion

STEP = 0.25
RAYS = {
    "nothing": [],
    "no density": [0.0, 0.0],
    "one sample": [3.0],
    "subnormal": [1e-42, 1e-40, 1e-38],
    "thin": [1e-8] * 200,
    "opaque first": [1e6, 1.0, 1.0],
    "opaque last": [0.1, 0.2, 1e8],
    "ordinary": [0.5, 2.0, 8.0, 1.0, 0.0, 30.0],
}


def packed(dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
    torch.manual_seed(0)
    sigmas = torch.tensor([s for ray in RAYS.values() for s in ray], dtype=dtype)
    counts = torch.tensor([len(ray) for ray in RAYS.values()])
    starts = torch.cumsum(counts, 0) - counts
    deltas = torch.full_like(sigmas, STEP)
    return sigmas, torch.randn(len(sigmas), 5, dtype=dtype), deltas, starts, counts


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 3e-6)])
def test_kernel_and_twin_match_the_equation(dtype: torch.dtype, tolerance: float) -> None:
    sigmas, features, deltas, starts, counts = packed(dtype)
    for function in (composite, twins.composite):
        out, opacity, weights = function(sigmas, features, deltas, starts, counts)
        for ray, (start, count) in enumerate(zip(starts.tolist(), counts.tolist(), strict=True)):
            rows = slice(start, start + count)
            expected, alpha = composite_ray(sigmas[rows].numpy(), features[rows].numpy(), STEP)
            np.testing.assert_allclose(out[ray].numpy(), expected, rtol=0, atol=tolerance)
            assert opacity[ray].item() == pytest.approx(alpha, abs=tolerance, rel=1e-5)
            assert weights[rows].sum().item() == pytest.approx(alpha, abs=tolerance, rel=1e-5)


def test_thin_samples_are_not_lost() -> None:
    # A product of (1 - alpha) in float32 would find no opacity at all here.
    n = 10_000
    sigmas, features = torch.full((n,), 1e-9), torch.ones(n, 1)
    _, opacity, _ = composite(sigmas, features, torch.ones(n), torch.tensor([0]), torch.tensor([n]))
    assert opacity.item() == pytest.approx(1e-5, rel=1e-3)


def test_weights_sum_to_the_opacity() -> None:
    sigmas, _, deltas, starts, counts = packed(torch.float64)
    ones = torch.ones(len(sigmas), 1, dtype=torch.float64)
    out, opacity, _ = composite(sigmas, ones, deltas, starts, counts)
    torch.testing.assert_close(out[:, 0], opacity, rtol=1e-12, atol=0)


def test_gradients_match_finite_differences() -> None:
    torch.manual_seed(3)
    sigmas = (torch.rand(9, dtype=torch.float64) * 4).requires_grad_()
    features = torch.randn(9, 3, dtype=torch.float64, requires_grad=True)
    starts, counts = torch.tensor([0, 4, 4]), torch.tensor([4, 0, 5])
    deltas = torch.rand(9, dtype=torch.float64)
    assert torch.autograd.gradcheck(composite, (sigmas, features, deltas, starts, counts))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradients_match_autograd_on_hard_inputs(dtype: torch.dtype) -> None:
    sigmas, features, deltas, starts, counts = packed(dtype)
    gradients = []
    for function in (composite, twins.composite):
        s, f = sigmas.clone().requires_grad_(), features.clone().requires_grad_()
        outputs = function(s, f, deltas, starts, counts)
        torch.manual_seed(5)
        sum((out * torch.randn_like(out)).sum() for out in outputs).backward()
        gradients.append((s.grad, f.grad))
    tolerance = 1e-12 if dtype == torch.float64 else 3e-5
    for ours, twin in zip(*gradients, strict=True):
        assert torch.isfinite(ours).all()
        torch.testing.assert_close(ours, twin, rtol=1e-4, atol=tolerance)


REACHES = [1e-9, 0.1, 0.3, 1.0]
"""Reaches of the distortion loss; the intervals of the samples lie in [0, 1]."""


def naive_distortion(weights: np.ndarray, mids: np.ndarray, widths: np.ndarray, reach: float) -> float:
    """Evaluate equation 15 of mip-NeRF 360 pair by pair, with each distance at most `reach`."""
    every = range(len(mids))
    pairs = sum(weights[i] * weights[j] * min(abs(mids[i] - mids[j]), reach) for i in every for j in every)
    return pairs + float((weights**2 * widths).sum()) / 3


def intervals(counts: list[int]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    torch.manual_seed(1)
    edges = [torch.sort(torch.rand(n + 1, dtype=torch.float64)).values for n in counts]
    mids = torch.cat([(e[1:] + e[:-1]) / 2 for e in edges])
    widths = torch.cat([e[1:] - e[:-1] for e in edges])
    lengths = torch.tensor(counts)
    return mids, widths, torch.cumsum(lengths, 0) - lengths, lengths


@pytest.mark.parametrize("reach", REACHES)
def test_distortion_is_the_sum_over_pairs(reach: float) -> None:
    mids, widths, starts, counts = intervals([5, 0, 1, 12])
    weights = torch.rand(len(mids), dtype=torch.float64)
    losses = distortion(weights, mids, widths, reach, starts, counts)
    for ray, (start, count) in enumerate(zip(starts.tolist(), counts.tolist(), strict=True)):
        rows = slice(start, start + count)
        values = (values[rows].numpy() for values in (weights, mids, widths))
        expected = naive_distortion(*values, reach)
        assert losses[ray].item() == pytest.approx(expected, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("reach", REACHES)
def test_distortion_gradient_matches_finite_differences(reach: float) -> None:
    mids, widths, starts, counts = intervals([4, 0, 5])
    weights = torch.rand(len(mids), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: distortion(w, mids, widths, reach, starts, counts), (weights,))


def test_two_surfaces_are_drawn_together_within_reach_alone() -> None:
    """The distortion loss draws surfaces together only within `reach`; beyond, distances do not matter."""
    widths, starts, counts = torch.full((2,), 1e-3), torch.tensor([0]), torch.tensor([2])
    weights = torch.tensor([0.35, 0.65])
    near, at, behind, far = (
        distortion(weights, torch.tensor([0.2, mid]), widths, 0.01, starts, counts).item()
        for mid in (0.205, 0.21, 0.3, 0.9)
    )
    assert near < 0.6 * at
    assert at == pytest.approx(behind, rel=1e-4) == far


def test_distortion_gradient_reaches_rays_out_of_order() -> None:
    mids, widths, starts, counts = intervals([3, 2])
    weights = torch.rand(5, dtype=torch.float64, requires_grad=True)
    backwards = distortion(weights, mids, widths, 1.0, starts.flip(0), counts.flip(0))
    (gradient,) = torch.autograd.grad(backwards[1], weights)
    assert (gradient[:3] != 0).all() and (gradient[3:] == 0).all()


@pytest.mark.parametrize("width", [0, 16])
def test_a_field_is_composited_as_its_parts_are(width: int) -> None:
    """One function for density network and compositing equals the two in float64, one after the other."""
    torch.manual_seed(1)
    density, exact = DensityNetwork(6, width), DensityNetwork(6, width).double()
    for parameter in density.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    exact.load_state_dict(density.state_dict())
    counts = torch.tensor([3, 0, 1, 20])
    starts = torch.cumsum(counts, 0) - counts
    features = 2 * torch.randn(24, 6)
    features[0], features[1], features[2] = 0, 60, -60  # a saturated density, and one that is gone
    deltas = torch.full((24,), STEP)
    found = []
    for network, dtype in ((density, torch.float32), (exact, torch.float64)):
        f = features.detach().to(dtype, copy=True).requires_grad_()
        if dtype == torch.float64:
            outputs = twins.composite(network(f), f, deltas.double(), starts, counts)
        else:
            sigmas = network.logits(f).detach().clamp(max=LARGEST_LOGIT).exp()
            outputs = composite_field(network, f, sigmas, deltas, starts, counts)
        torch.manual_seed(2)
        sum((out * torch.randn(out.shape)).sum() for out in outputs).backward()
        found.append([*(out.detach() for out in outputs), f.grad, *(p.grad for p in network.parameters())])
    for ours, theirs in zip(*found, strict=True):
        scale = max(float(theirs.abs().max()), 1.0)
        torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=1e-5 * scale)


def test_nothing_is_composited_of_nothing() -> None:
    density, none = DensityNetwork(2, 4), torch.zeros(0, dtype=torch.int64)
    features = torch.empty(0, 2, requires_grad=True)
    outputs = composite_field(density, features, torch.empty(0), torch.empty(0), none, none)
    sum(out.sum() for out in outputs).backward()
    assert features.grad.shape == (0, 2)
    assert not any(parameter.grad.any() for parameter in density.parameters())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_faint_gradients_are_silenced(dtype: type) -> None:
    rows = np.array([[3.0, 4.0], [0.3, 0.4], [1e-30, 0.0], [0.0, 0.0]], dtype)
    root = np.sqrt((25 + 0.25) / 4)
    for faint, n_kept in ((0.0, 3), (0.49 / root, 2), (0.51 / root, 1)):
        gradients = rows.copy()
        silence(gradients, dtype(faint))
        np.testing.assert_array_equal(gradients[:n_kept], rows[:n_kept])
        assert not gradients[n_kept:].any()
    bad = np.array([[np.nan, 0.0], [1.0, 0.0]], dtype)
    silence(bad, dtype(0.5))
    assert np.isnan(bad[0, 0]) and bad[1, 0] == 1, "a bad step is seen, not hidden"
    silence(rows[:0], dtype(0.5))
