"""Proposal sampling in torch compared with the numba kernels and the formulas in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.reference import contract
from tests.vfr_bake.rendering.test_proposals import (
    HISTOGRAMS,
    make,
    naive_interlevel,
    naive_resample,
)
from vfr_bake.config import TrainConfig
from vfr_bake.kernels import proposals as compiled
from vfr_bake.kernels.proposals import Round, spacing
from vfr_bake.rendering.compositing import RaySamples
from vfr_bake.rendering.proposals import N_FINAL, N_PROPOSED, ProposalGrid
from vfr_bake.torch_kernels import proposals as kernels
from vfr_bake.training.device_guides import DeviceProposalGuide, field_samples, proposal_weights
from vfr_bake.training.guides import ProposalGuide


@pytest.mark.parametrize("size", [0.0, 1e-30, 0.3, 0.999, 1.0, 1.001, 2.0, 1e3, 1e10, 1e30, 3e38])
def test_contraction_is_equation_10(size: float, device: torch.device) -> None:
    directions = [[1, 0, 0], [0, -1, 0], [0.6, 0.0, -0.8], [0.5773, -0.5773, 0.5773]]
    points = (np.array(directions) * size).astype(np.float32)
    ours = kernels.contracted_unit(torch.from_numpy(points).to(device)).cpu().numpy()
    expected = [(contract(point) + 2) / 4 for point in points.astype(np.float64)]
    np.testing.assert_allclose(ours, np.stack(expected), rtol=0, atol=3e-7)


def test_distance_is_the_inverse_of_the_kernels_spacing(device: torch.device) -> None:
    t = np.array([0.0, 1e-6, 0.5, 1 - 1e-7, 1.0, 1 + 1e-6, 7.0, 1e3])
    s = torch.tensor([spacing(value) for value in t], dtype=torch.float64, device=device)
    np.testing.assert_allclose(kernels.distance(s).cpu().numpy(), t, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("jitter", [0.0, 0.5, 0.999])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 2e-5)])
def test_resampling_inverts_the_distribution(
    jitter: float, dtype: torch.dtype, tolerance: float, device: torch.device
) -> None:
    weights = np.stack(list(HISTOGRAMS.values()))
    edges = np.sort(np.random.default_rng(0).random((len(weights), 17)))
    tensors = (torch.from_numpy(a).to(device, dtype) for a in (edges, weights))
    jitters = torch.full((len(weights),), jitter, device=device, dtype=dtype)
    ours = kernels.resample(*tensors, 1.0, jitters, 8).cpu().numpy()
    for row, name in enumerate(HISTOGRAMS):
        expected = naive_resample(edges[row], weights[row], 8, jitter)
        np.testing.assert_allclose(ours[row], expected, rtol=0, atol=tolerance, err_msg=name)
    assert (np.diff(ours) >= 0).all()
    low, high = edges.astype(ours.dtype)[:, 0], edges.astype(ours.dtype)[:, -1]
    assert (ours[:, 0] >= low).all() and (ours[:, -1] <= high).all()


def test_one_interval_is_the_whole_and_no_ray_is_none(device: torch.device) -> None:
    edges = torch.tensor([[0.1, 0.4, 0.9]], device=device)
    weights, jitter = torch.ones(1, 2, device=device), torch.zeros(1, device=device)
    torch.testing.assert_close(kernels.resample(edges, weights, 1.0, jitter, 1), edges[:, [0, 2]])
    assert kernels.resample(edges[:0], weights[:0], 1.0, jitter[:0], 5).shape == (0, 6)


def test_interlevel_loss_and_its_gradient(device: torch.device) -> None:
    random = np.random.default_rng(1)
    n, m, n_rays = 7, 5, 6
    edges = np.sort(random.random((n_rays, m + 1)))
    weights = random.random((n_rays, m)) * 0.4
    p_edges = np.sort(random.random((n_rays, n + 1)))
    p_edges[:, 0], p_edges[:, -1] = 0, 1
    edges[1] += 2  # beyond the proposal's last interval
    edges[2, 2] = edges[2, 1]  # an interval of no length
    p_edges[3, 3] = edges[3, 2]  # equal borders
    p_edges.sort(axis=1)
    p_weights = torch.from_numpy(random.random((n_rays, n)) * 0.05).to(device).requires_grad_()
    tensors = [torch.from_numpy(a).to(device) for a in (edges, weights, p_edges)]
    losses = kernels.interlevel(*tensors, p_weights)
    proposed = p_weights.detach().cpu().numpy()
    expected, depths, starts = np.empty(n_rays), np.zeros((n_rays, n)), np.arange(n_rays) * m
    found = Round(p_edges, depths, np.empty((n_rays, 3, n)), proposed)
    compiled.interlevel(
        edges, starts, np.full(n_rays, m), weights.reshape(-1), found, expected, np.empty((n_rays, n))
    )
    np.testing.assert_allclose(losses.detach().cpu().numpy(), expected, rtol=1e-12)
    for ray in (0, 3, 4, 5):
        naive = naive_interlevel(edges[ray], weights[ray], p_edges[ray], proposed[ray])
        assert losses[ray].item() == pytest.approx(naive, rel=1e-12)
    assert torch.isfinite(losses).all() and (losses > 0).all()
    assert torch.autograd.gradcheck(lambda p: kernels.interlevel(*tensors, p), (p_weights,))


def guides(device: torch.device) -> tuple[ProposalGuide, DeviceProposalGuide]:
    """Return the guides of the numba kernels and of torch, with the same tables."""
    _, sampler, _, _ = make()
    config = TrainConfig()
    pace = config.for_device("cpu", True)
    ours, expected = DeviceProposalGuide(pace, 0.05, device), ProposalGuide(pace, 0.05)
    for guide in (ours._sampler, expected.sampler):
        guide.load_state_dict(sampler.state_dict())
    return expected, ours


@pytest.mark.parametrize("step", [0, 10, 1000])
def test_every_stage_is_the_kernels_in_float64(step: int, device: torch.device) -> None:
    """Each stage in torch equals the kernels' in float64. It starts from the result of the kernels' previous
    stage, because each round magnifies rounding a thousandfold where a distribution is flat."""
    field, _, *rays = make()
    torch.manual_seed(3)
    jitter = torch.rand(40, 3)
    expected, guide = guides(device)
    for each in (expected, guide):
        each.prepare(step, field)
    found = expected.sample(field, *rays, jitter, pilot=False, share=1.0)
    rounds = [Round(*(tensor.numpy() for tensor in each)) for each in found.trail["rounds"]]
    edges = found.trail["edges"]
    guide._sampler.double()
    field.double().to(device).grid.backend = "torch"
    o, d, shifts = (a.double().to(device) for a in (*rays, jitter))
    before = torch.tensor([guide._borders] * 40), torch.ones(40, 1)
    for number, (grid, now) in enumerate(zip(guide._sampler.grids, rounds, strict=True)):
        assert isinstance(grid, ProposalGrid)
        exponent = guide._exponent if number else 1.0
        drawn = kernels.resample(*doubles(device, *before), exponent, shifts[:, number], N_PROPOSED)
        same_borders(now.edges, drawn)
        weights = proposal_weights(grid, o, d, *doubles(device, torch.from_numpy(now.edges)))
        np.testing.assert_allclose(now.weights, weights.detach().cpu().numpy(), rtol=1e-3, atol=3e-5)
        before = torch.from_numpy(now.edges), torch.from_numpy(now.weights)
    drawn = kernels.resample(*doubles(device, *before), guide._exponent, shifts[:, 2], guide._n_final)
    same_borders(edges.numpy(), drawn)
    samples = field_samples(field, o, d, *doubles(device, edges))
    assert samples.counts.tolist() == found.counts.tolist()
    for name in ("t_mid", "deltas", "points", "features"):
        ours, theirs = getattr(samples, name).cpu().numpy(), getattr(found, name).numpy()
        np.testing.assert_allclose(theirs, ours, rtol=1e-4, atol=3e-5, err_msg=name)


def same_borders(ours: np.ndarray, expected: torch.Tensor) -> None:
    """Assert equal borders up to float32 rounding: a sum of 64 masses of up to 1 is known to 4e-6, which is
    4e-3 of an interval that has no more mass than the padding of 1e-3. Few borders lie in such intervals."""
    off = np.abs(ours - expected.cpu().numpy())
    assert off.max() < 1e-3 and np.quantile(off, 0.99) < 3e-5


def doubles(device: torch.device, *tensors: torch.Tensor) -> list[torch.Tensor]:
    return [tensor.to(device, torch.float64) for tensor in tensors]


def test_proposals_learn_ever_more_rarely_and_samples_get_half_as_many(device: torch.device) -> None:
    field, _, *rays = make()
    jitter = torch.rand(40, 3)
    for guide in guides(device):
        learnt = []
        for step in range(2000):
            guide.prepare(step, field)
            learnt.append(guide._learns)
        assert all(learnt[:200]) and learnt[200:400] == [True, False] * 100
        assert [sum(learnt[n : n + 60]) for n in (400, 600, 840, 1500)] == [20, 15, 12, 12]
        for step, n in ((0, N_FINAL), (511, N_FINAL), (512, N_FINAL // 2), (10**6, N_FINAL // 2)):
            guide.prepare(step, field)
            if isinstance(guide, ProposalGuide):
                samples = guide.sample(field, *rays, jitter, pilot=False, share=1.0)
                assert samples.trail["edges"].shape == (40, n + 1)
                assert len(guide.tables(samples)) == 2 * samples.trail["learns"]
            assert guide._n_final == n


@pytest.mark.parametrize("step", [0, 5])
@pytest.mark.parametrize("bias", [0.0, 20.0])
def test_both_guides_find_the_same_and_learn_the_same(step: int, bias: float, device: torch.device) -> None:
    """Both guides give the same samples, regulariser and gradients of tables. With a bias of 20, every first
    sample is opaque."""
    field, _, rays_o, rays_d = make()
    with torch.no_grad():
        field.density.out.bias.fill_(bias)
    torch.manual_seed(3)
    jitter, noise = torch.rand(40, 3), torch.rand(40 * 32)
    found, losses, gradients = [], [], []
    for guide, place in zip(guides(device), (torch.device("cpu"), device), strict=True):
        if isinstance(guide, DeviceProposalGuide):
            field = field.to(place)
            field.grid.backend = "torch"
        guide.prepare(step, field)
        rays = (a.to(place) for a in (rays_o, rays_d, jitter))
        samples = guide.sample(field, *rays, pilot=False, share=1.0)
        weights = noise[: len(samples.t_mid)].to(place)
        losses.append(guide.regulariser(samples, weights))
        guide.add_gradients(samples, weights, 40)
        found.append(samples)
        gradients.append([table.gradient.cpu() for table in guide.tables(samples)])
    same_samples(found[1], found[0])
    torch.testing.assert_close(losses[1].cpu(), losses[0], rtol=1e-4, atol=1e-7)
    assert len(gradients[0]) == len(gradients[1]) == 2
    for ours, expected in zip(*reversed(gradients), strict=True):
        # Rounding decides whether an interval counts as overlapping one that it only touches.
        close = (ours - expected).abs() <= 1e-3 * expected.abs() + 2e-4 * expected.abs().max()
        assert expected.abs().max() > 0 and int((~close).sum()) <= 1e-4 * len(close)
        assert (ours - expected).norm() < 0.02 * expected.norm()


def same_samples(ours: RaySamples, expected: RaySamples) -> None:
    assert torch.equal(ours.counts.cpu(), expected.counts) and torch.equal(ours.starts.cpu(), expected.starts)
    # Borders are drawn from sums of 64 weights in another order; far out, rounding of s grows in t.
    torch.testing.assert_close(ours.t_mid.cpu(), expected.t_mid, rtol=2e-3, atol=1e-5)
    torch.testing.assert_close(ours.deltas.cpu(), expected.deltas, rtol=5e-2, atol=1e-5)
    # A border lies where sums of weights reach a share; in an interval with hardly more than the padding of
    # 1e-3 a rounding of 6e-8 moves it by 6e-5 of the interval, and intervals are up to half the cube long.
    torch.testing.assert_close(ours.points.cpu(), expected.points, rtol=0, atol=3e-5)


def test_no_ray_at_all(device: torch.device) -> None:
    field = make()[0].to(device)
    field.grid.backend = "torch"
    _, guide = guides(device)
    guide.prepare(0, field)
    none = torch.zeros(0, 3, device=device)
    samples = guide.sample(field, none, none, none, pilot=False, share=1.0)
    assert len(samples.t_mid) == len(samples.counts) == 0
    guide.add_gradients(samples, none[:, 0], 0)


def test_a_saturated_density_can_come_down(device: torch.device) -> None:
    logits = torch.tensor([[-1e30, 0.0, 20.0, 1e9]], device=device, requires_grad=True)
    weights = kernels.weights_of(logits, torch.tensor([[1.0, 1.0, 1e-7, 1e-9]], device=device))
    weights[0, 2].backward()
    sigma = np.exp(15.0) * 1e-7
    np.testing.assert_allclose(
        weights.detach().cpu().numpy()[0, 2], np.exp(-1) * -np.expm1(-sigma), rtol=1e-5
    )
    assert weights[0, 3].item() == pytest.approx(
        np.exp(-1 - sigma) * -np.expm1(-np.exp(15.0) * 1e-9), rel=1e-3
    )
    expected = [0, -np.exp(-1) * -np.expm1(-sigma), np.exp(-1) * sigma * np.exp(-sigma), 0]
    np.testing.assert_allclose(logits.grad.cpu().numpy()[0], expected, rtol=1e-5)
