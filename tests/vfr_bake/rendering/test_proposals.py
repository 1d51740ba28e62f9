"""Contraction, spacing, resampling and interlevel loss of proposals, compared with readable float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from player.march.march import OPAQUE_DEPTH
from tests.numerics.bounds import Row
from tests.reference import composite_ray, contract
from tests.vfr_bake import twins
from vfr_bake.config import FieldOptions
from vfr_bake.field.field import VfrField
from vfr_bake.kernels import proposals as kernels
from vfr_bake.kernels.contraction import contracted_unit
from vfr_bake.kernels.density import LARGEST_LOGIT
from vfr_bake.rendering.proposals import FAR, N_FINAL, N_PROPOSED, ProposalSampler
from vfr_bake.torch_kernels.hash_grid import encode
from vfr_bake.training.optimiser import GridAdam

ONE = np.float32(1)
SPACING = Row(
    "Field", "distance of a proposal's spacing, in float64", "t from 0 to the farthest", 1e-12, "of it",
    "without a seam at t = 1; below 1e-3, 1e-15",
)  # fmt: skip


@pytest.mark.parametrize("size", [0.0, 1e-30, 0.3, 0.999, 1.0, 1.001, 2.0, 1e3, 1e10, 1e30, 3e38])
def test_contraction_is_equation_10(size: float) -> None:
    for direction in ([1, 0, 0], [0, -1, 0], [0.6, 0.0, -0.8], [0.5773, -0.5773, 0.5773]):
        point = np.array(direction) * size
        x, y, z = (np.float32(value) for value in point)
        ours = np.array(contracted_unit(x, y, z, ONE))
        with np.errstate(over="ignore"):
            expected = (contract(np.array([x, y, z], np.float64)) + 2) / 4
        np.testing.assert_allclose(ours, expected, rtol=0, atol=3e-7)


def test_contraction_has_no_seam_at_the_unit_sphere() -> None:
    inside, outside = np.nextafter(ONE, np.float32(0)), np.nextafter(ONE, np.float32(2))
    values = [contracted_unit(x, np.float32(0), np.float32(0), ONE)[0] for x in (inside, ONE, outside)]
    assert values == sorted(values) and values[2] - values[0] < 2e-7


def test_spacing_and_distance_are_inverse() -> None:
    for t in (0.0, 1e-6, 0.5, 1 - 1e-7, 1.0, 1 + 1e-6, 7.0, FAR):
        s = kernels.spacing(np.float64(t))
        assert 0 <= s < 1
        SPACING.check(kernels.distance(s), t, of=max(t, 1e-3))


def naive_resample(edges: np.ndarray, weights: np.ndarray, m: int, jitter: float) -> np.ndarray:
    """Return the borders of m intervals around values of the inverse distribution function."""
    mass = weights + kernels.PADDING
    cdf = np.concatenate([[0], np.cumsum(mass)]) / mass.sum()
    centres = np.interp((np.arange(m) + jitter) / m, cdf, edges)
    inner = (centres[1:] + centres[:-1]) / 2
    first = max(edges[0], 2 * centres[0] - inner[0])
    last = min(edges[-1], 2 * centres[-1] - inner[-1])
    return np.concatenate([[first], inner, [last]])


HISTOGRAMS = {
    "flat": np.ones(16),
    "nothing": np.zeros(16),
    "one surface": np.eye(16)[5],
    "first": np.eye(16)[0],
    "last": np.eye(16)[15],
    "two": np.eye(16)[3] * 0.5 + np.eye(16)[12] * 0.5,
    "subnormal": np.full(16, 1e-40),
    "tail": 0.5 ** np.arange(16),
}


@pytest.mark.parametrize("name", HISTOGRAMS)
@pytest.mark.parametrize("jitter", [0.0, 0.5, 0.999])
def test_resampling_inverts_the_distribution(name: str, jitter: float) -> None:
    weights = HISTOGRAMS[name]
    edges = np.sort(np.random.default_rng(0).random(17))
    out = np.empty(9)
    kernels.resample(edges, weights, np.float64(1), np.float64(jitter), np.empty(17), np.empty(24), out)
    np.testing.assert_allclose(out, naive_resample(edges, weights, 8, jitter), rtol=0, atol=1e-9)
    assert (np.diff(out) >= 0).all() and out[0] >= edges[0] and out[-1] <= edges[-1]
    single, zero = (a.astype(np.float32) for a in (edges, weights))
    ours = np.empty(9, np.float32)
    scratch = np.empty(17, np.float32), np.empty(24, np.float32)
    kernels.resample(single, zero, ONE, np.float32(jitter), *scratch, ours)
    np.testing.assert_allclose(ours, out, rtol=0, atol=2e-5)


def naive_interlevel(
    edges: np.ndarray, weights: np.ndarray, p_edges: np.ndarray, p_weights: np.ndarray
) -> float:
    """Evaluate equation 13 of mip-NeRF 360, interval by interval."""
    total = 0.0
    for i, w in enumerate(weights):
        overlaps = (p_edges[:-1] < edges[i + 1]) & (p_edges[1:] > edges[i])
        total += max(0.0, w - p_weights[overlaps].sum()) ** 2 / (w + 1e-7)
    return total


def test_interlevel_loss_and_its_gradient() -> None:
    random = np.random.default_rng(1)
    n, m = 7, 5
    edges = np.sort(random.random((1, m + 1)))
    weights = random.random(m) * 0.4
    p_edges = np.concatenate([[0.0], np.sort(random.random(n - 1)), [0.999]])[None]
    lengths = np.diff([kernels.distance(s) for s in p_edges[0]])
    starts, counts = np.array([0]), np.array([m])

    def proposal(logits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        depths = np.exp(logits) * lengths
        before = np.cumsum(depths) - depths
        return depths, np.exp(-before) * -np.expm1(-depths)

    logits = random.normal(size=n)
    depths, p_weights = proposal(logits)
    losses, gradient = np.empty(1), np.empty((1, n))
    found = kernels.Round(p_edges, depths[None], np.empty((1, 3, n)), p_weights[None])
    kernels.interlevel(edges, starts, counts, weights, found, losses, gradient)
    assert losses[0] == pytest.approx(naive_interlevel(edges[0], weights, p_edges[0], p_weights), rel=1e-12)
    assert losses[0] > 0
    for j in range(n):
        shifted = [logits + np.eye(n)[j] * h for h in (1e-6, -1e-6)]
        up, down = (naive_interlevel(edges[0], weights, p_edges[0], proposal(s)[1]) for s in shifted)
        assert gradient[0, j] == pytest.approx((up - down) / 2e-6, rel=1e-5, abs=1e-8)


def make(seed: int = 0) -> tuple[VfrField, ProposalSampler, torch.Tensor, torch.Tensor]:
    torch.manual_seed(seed)
    config = FieldOptions(n_levels=4, max_resolution=64, log2_table_size=12, head_width=16).resolved(True)
    field, sampler = VfrField(config), ProposalSampler(0.05)
    torch.nn.init.uniform_(field.grid.table, -1, 1)
    for grid in sampler.grids:
        torch.nn.init.uniform_(grid.table, -2, 2)
    rays_o = torch.rand(40, 3) - 0.5
    rays_d = torch.nn.functional.normalize(torch.randn(40, 3), dim=-1)
    return field, sampler, rays_o, rays_d


def test_samples_lie_where_they_say() -> None:
    field, sampler, rays_o, rays_d = make()
    samples, edges, rounds = sampler.sample_rounds(field, rays_o, rays_d, torch.rand(40, 3))
    assert [r.edges.shape for r in rounds] == [(40, N_PROPOSED + 1)] * 2 and edges.shape == (40, N_FINAL + 1)
    assert int(samples.counts.sum()) == len(samples.t_mid) and int(samples.counts.min()) >= 1
    owner = torch.arange(40).repeat_interleave(samples.counts)
    points = (rays_o[owner] + samples.t_mid[:, None] * rays_d[owner]).double().numpy()
    expected = np.stack([(contract(point) + 2) / 4 for point in points])
    np.testing.assert_allclose(samples.points.numpy(), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(samples.features, twins.encode(field.grid, samples.points), rtol=0, atol=1e-5)
    with torch.no_grad():
        torch.testing.assert_close(samples.sigmas, field.density(samples.features), rtol=1e-5, atol=0)


@pytest.mark.parametrize("scale", [0.0, 2.0, 30.0])
def test_rounds_are_the_equations_in_float64(scale: float) -> None:
    """The points, depths and weights of each round, at the edges that the round drew, are those of float64.
    With a scale of 30, densities reach the largest and rays become opaque."""
    field, sampler, rays_o, rays_d = make()
    for grid in sampler.grids:
        torch.nn.init.uniform_(grid.table, -scale, scale)
    _, _, rounds = sampler.sample_rounds(field, rays_o, rays_d, torch.rand(40, 3))
    o, d = rays_o[:, None].double().numpy(), rays_d[:, None].double().numpy()
    for grid, found in zip(sampler.grids, rounds, strict=True):
        t = np.vectorize(kernels.distance)(found.edges.astype(np.float64))
        lengths = np.diff(t, axis=1)
        points = o + (t[:, 1:] + t[:, :-1])[..., None] / 2 * d
        points = (np.apply_along_axis(contract, 2, points) + 2) / 4
        rows = torch.from_numpy(points.reshape(-1, 3))
        layout = grid.layout
        logits = encode(rows, grid.table.detach().double(), layout.levels(grid.table.double())).sum(dim=1)
        depths = np.exp(np.minimum(logits.numpy().reshape(lengths.shape), LARGEST_LOGIT)) * lengths
        before = np.cumsum(depths, axis=1) - depths
        seen = before < OPAQUE_DEPTH * 0.99
        assert seen.any(axis=1).all() and (scale < 30 or not seen.all())
        np.testing.assert_allclose(found.points.transpose(0, 2, 1)[seen], points[seen], rtol=0, atol=1e-6)
        # A logit sums up to ten numbers of size `scale`, at places known to 1e-6 in up to 512 cells.
        close = {"rtol": 1e-4 + 1e-3 * scale, "atol": 1e-7}
        np.testing.assert_allclose(found.depths[seen], depths[seen], **close)
        ours = np.cumsum(found.depths.astype(np.float64), axis=1) - found.depths
        weights = np.exp(-ours) * -np.expm1(-found.depths.astype(np.float64))
        np.testing.assert_allclose(found.weights[seen], weights[seen], rtol=1e-5, atol=1e-7)
        behind = before > OPAQUE_DEPTH * 1.01
        assert not found.weights[behind].any() and not found.depths[behind].any()


def test_thin_and_opaque_depths_keep_their_digits() -> None:
    """Weights keep their precision if all intervals have one density, from almost 0 to the largest."""
    field, sampler, rays_o, rays_d = make()
    for logit in (-1e4, -80.0, -60.0, -20.0, -5.0, -1.0, 0.0, 3.0, LARGEST_LOGIT, 1e4):
        with torch.no_grad():
            for grid in sampler.grids:
                grid.table.zero_()
                grid.table[: 17**3] = logit  # the rows of the coarsest level only
        _, _, rounds = sampler.sample_rounds(field, rays_o, rays_d, torch.rand(40, 3))
        for found in rounds:
            lengths = np.diff(np.vectorize(kernels.distance)(found.edges.astype(np.float64)), axis=1)
            depths = np.exp(min(logit, LARGEST_LOGIT)) * lengths
            before = np.cumsum(depths, axis=1) - depths
            seen = before < OPAQUE_DEPTH * 0.99
            weights = np.where(seen, np.exp(-before) * -np.expm1(-depths), 0)
            np.testing.assert_allclose(found.weights[seen], weights[seen], rtol=2e-3, atol=1e-37)


def test_rays_may_lie_axis_by_axis() -> None:
    """Rays may be stored axis by axis (in Fortran order), as those of a camera are."""
    field, sampler, rays_o, rays_d = make()
    expected = sampler.sample_all(field, rays_o.numpy(), rays_d.numpy())
    samples = sampler.sample_all(field, *(np.asfortranarray(rays.numpy()) for rays in (rays_o, rays_d)))
    for name in ("t_mid", "points", "features", "sigmas"):
        torch.testing.assert_close(getattr(samples, name), getattr(expected, name), rtol=0, atol=0)


def test_no_ray_at_all() -> None:
    field, sampler, rays_o, rays_d = make()
    samples, edges, rounds = sampler.sample_rounds(field, rays_o[:0], rays_d[:0], torch.zeros(0, 3))
    assert len(samples.t_mid) == len(samples.counts) == len(edges) == 0
    adams = [GridAdam(grid.table) for grid in sampler.grids]
    assert sampler.add_gradients(rounds, edges, samples, torch.zeros(0), 1) == 0
    assert not any(adam.gradient.any() for adam in adams)


def test_a_density_that_is_no_number_is_seen() -> None:
    field, sampler, rays_o, rays_d = make()
    with torch.no_grad():
        sampler.grids[1].table.fill_(float("nan"))
    _, _, rounds = sampler.sample_rounds(field, rays_o, rays_d, torch.rand(40, 3))
    assert np.isfinite(rounds[0].weights).all() and np.isnan(rounds[1].weights).all()


def test_nothing_is_looked_up_behind_an_opaque_sample() -> None:
    field, sampler, rays_o, rays_d = make()
    with torch.no_grad():
        field.density.out.bias.fill_(20)
    samples = sampler.sample_all(field, rays_o.numpy(), rays_d.numpy())
    whole = (samples.deltas > 1e-4)[samples.starts]  # a first interval of some length is opaque
    assert (samples.counts[whole] == 1).all()


def test_rendering_is_the_equation_over_the_samples() -> None:
    field, sampler, rays_o, rays_d = make()
    features, opacity = sampler.composited_features(field, rays_o.numpy(), rays_d.numpy())
    samples = sampler.sample_all(field, rays_o.numpy(), rays_d.numpy())
    with torch.no_grad():
        sigmas = field.density(samples.features) * samples.deltas
    for ray in range(0, 40, 7):
        rows = slice(samples.starts[ray], samples.starts[ray] + samples.counts[ray])
        out, alpha = composite_ray(sigmas[rows].numpy(), samples.features[rows].numpy(), 1.0)
        np.testing.assert_allclose(features[ray], out, rtol=0, atol=2e-6)
        assert opacity[ray] == pytest.approx(alpha, abs=2e-6)


def test_proposals_learn_where_the_field_has_its_weight() -> None:
    field, sampler, rays_o, rays_d = make()
    adams = [GridAdam(grid.table) for grid in sampler.grids]
    losses = []
    for step in range(60):
        jitter = torch.rand(40, 3, generator=torch.Generator().manual_seed(step))
        samples, edges, rounds = sampler.sample_rounds(field, rays_o, rays_d, jitter)
        with torch.no_grad():
            sigmas = field.density(samples.features) * samples.deltas
        before = torch.cat([torch.cumsum(s, 0) - s for s in torch.split(sigmas, samples.counts.tolist())])
        weights = torch.exp(-before) * -torch.expm1(-sigmas)
        losses.append(sampler.add_gradients(rounds, edges, samples, weights, 40))
        for adam in adams:
            adam.step(0.05)
    assert np.mean(losses[-5:]) < 0.3 * np.mean(losses[:5])
