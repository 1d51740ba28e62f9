"""The march through a grid of contracted space against readable float64, and what the grid learns."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tests.reference import composite_ray
from tests.vfr_bake import twins
from vfr_bake.config import FieldOptions
from vfr_bake.field.field import VfrField
from vfr_bake.kernels.density import LIMITS
from vfr_bake.kernels.space import END, gather, settle
from vfr_bake.rendering import space_grid
from vfr_bake.rendering.space_grid import (
    FINER,
    FLOOR,
    MASS,
    MOST_DEPTH,
    MOST_SAMPLES,
    RESOLUTION,
    STEP,
    THRESHOLD,
    SpaceGrid,
    steps_around,
)

NEAR = 0.05


def contract(point: np.ndarray) -> np.ndarray:
    """Mip-NeRF 360, equation 10, in float64."""
    norm = np.linalg.norm(point)
    return point if norm <= 1 else (2 - 1 / norm) * point / norm


def make(logit: float = 0.0) -> VfrField:
    torch.manual_seed(0)
    options = FieldOptions(n_levels=4, max_resolution=64, log2_table_size=12, head_width=16)
    field = VfrField(options.resolved(True))
    torch.nn.init.uniform_(field.grid.table, -1, 1)
    with torch.no_grad():
        field.density.out.bias.fill_(logit)
    return field


def some_rays() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    rays_o = torch.rand(30, 3, generator=generator) - 0.5
    rays_d = torch.nn.functional.normalize(torch.randn(30, 3, generator=generator), dim=-1)
    hard = [
        ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),  # along an axis, through the origin
        ([0.3, 0.3, 0.7], [0.0, -0.0, -1.0]),  # with -0.0
        ([3.0, -2.0, 1.0], [-0.6, 0.8, 0.0]),  # from outside the unit ball
        ([5.0, 0.0, 0.0], [1.0, 0.0, 0.0]),  # away from it
        ([0.0, 40.0, 0.0], [0.0, 0.0, 1.0]),  # past it
        ([1e6, 0.0, 0.0], [-1.0, 0.0, 0.0]),  # from far away
        ([1e6, 1e6, 0.0], [0.0, 0.6, 0.8]),  # from far away, past it
    ]
    extra_o, extra_d = (torch.tensor(column) for column in zip(*hard, strict=True))
    return torch.cat([rays_o, extra_o]), torch.cat([rays_d, extra_d])


def half_full(seed: int = 0) -> SpaceGrid:
    grid = SpaceGrid(NEAR, seed=0)
    random = np.random.default_rng(seed)
    coarse = np.exp(random.normal(0, 2, (16,) * 3)) * (random.random((16,) * 3) < 0.4)
    grid.densities[:] = np.kron(coarse, np.ones((RESOLUTION // 16,) * 3))
    grid.threshold = THRESHOLD
    return grid


def naive_march(field: VfrField, grid: SpaceGrid, o: np.ndarray, d: np.ndarray, jitter: float) -> list[tuple]:
    """(t, delta) of a ray's samples in float64, by t and not by sums of angles."""
    t_p = -float(o @ d)
    w = max(1.0, float(np.linalg.norm(o + t_p * d)))
    begin, end = math.atan((NEAR - t_p) / w), math.pi / 2 - END
    n = max(int((end - begin) / STEP), 1)
    step = (end - begin) / n
    found: list[tuple] = []
    tau, gathered, goal = 0.0, 0.0, MASS * jitter
    for i in range(n):
        t0, t, t1 = (t_p + w * math.tan(begin + x * step) for x in (i, i + 0.5, i + 1))
        cell = ((contract(o + t * d) + 2) / 4 * RESOLUTION).astype(int).clip(0, RESOLUTION - 1)
        depth = min(float(grid.densities[tuple(cell)]) * (t1 - t0), MOST_DEPTH)
        if depth < grid.threshold:
            continue
        place = 0.0  # share of the step that is behind us
        while True:
            rate = max(math.exp(-tau) * -math.expm1(-depth), FLOOR)
            if gathered + rate * (1 - place) < goal:
                gathered += rate * (1 - place)
                break
            place += (goal - gathered) / rate
            gathered, goal = 0.0, MASS
            t = t_p + w * math.tan(begin + (i + place) * step)
            delta = (t1 - t0) * MASS / rate
            point = (contract(o + t * d) + 2) / 4
            found.append((t, delta))
            tau += math.exp(float(field.log_densities(point[None].astype(np.float32))[0])) * delta
            if tau > LIMITS.opaque_depth or len(found) == MOST_SAMPLES:
                return found
    return found


@pytest.mark.parametrize("logit", [-9.0, 0.0, 2.0])
@pytest.mark.parametrize("jitter", [0.0, 0.5, 0.999])
def test_the_march_is_the_one_that_is_written_down(logit: float, jitter: float) -> None:
    field, grid = make(logit), half_full()
    rays_o, rays_d = some_rays()
    samples, sigmas, intervals = grid.march(field, rays_o, rays_d, torch.full((len(rays_o),), jitter))
    n_other = 0
    for ray in range(len(rays_o)):
        o, d = rays_o[ray].double().numpy(), rays_d[ray].double().numpy()
        expected = naive_march(field, grid, o, d, jitter)
        rows = slice(int(samples.starts[ray]), int(samples.starts[ray] + samples.counts[ray]))
        found = np.stack([samples.t_mid[rows].numpy(), samples.deltas[rows].numpy()], axis=1)
        angles = intervals.angles[rows]
        assert (torch.diff(angles) >= 0).all() and (intervals.widths[rows] > 0).all()
        # A step whose middle is within rounding of a border of a cell takes the density of either.
        wanted = np.array(expected).reshape(-1, 2)
        far = 10 * abs(float(rays_o[ray].abs().max()))  # t in float32 is no better than its largest summand
        same = len(found) == len(wanted) and np.allclose(found, wanted, rtol=2e-2, atol=1e-4 + 1e-6 * far)
        n_other += not same
    assert n_other <= len(rays_o) // 6
    assert len(sigmas) > 2 * len(rays_o)
    assert torch.isfinite(samples.t_mid).all() and torch.isfinite(samples.deltas).all()
    assert (samples.deltas > 0).all() and (samples.points >= 0).all() and (samples.points <= 1).all()
    torch.testing.assert_close(samples.features, twins.encode(field.grid, samples.points), rtol=0, atol=1e-5)
    np.testing.assert_allclose(sigmas, field.density(samples.features).detach().numpy(), rtol=1e-4)


def test_samples_lie_where_they_say() -> None:
    field, grid = make(), half_full()
    rays_o, rays_d = (rays[:30] for rays in some_rays())
    samples = grid.sample_all(field, rays_o.numpy(), rays_d.numpy())
    owner = torch.arange(30).repeat_interleave(samples.counts)
    points = (rays_o[owner].double() + samples.t_mid[:, None].double() * rays_d[owner].double()).numpy()
    expected = np.stack([(contract(point) + 2) / 4 for point in points])
    np.testing.assert_allclose(samples.points.numpy(), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("density", [0.0, 1.0])
def test_the_optical_depth_of_a_field_that_fills_space_is_the_rays_length(density: float) -> None:
    """Where all steps are live, what the samples of a ray stand for adds up to its length."""
    field, grid = make(-20.0), SpaceGrid(NEAR, seed=0)
    grid.densities[:] = density
    rays_o, rays_d = (rays[:20] for rays in some_rays())
    jitter = torch.rand(20, generator=torch.Generator().manual_seed(0))
    samples, _, intervals = grid.march(field, rays_o, rays_d, jitter)
    totals = [float(part.sum()) for part in torch.split(intervals.widths, samples.counts.tolist())]
    t_p = -(rays_o * rays_d).sum(dim=1)
    w = (rays_o + t_p[:, None] * rays_d).norm(dim=1).clamp(min=1)
    lengths = math.pi / 2 - END - torch.atan((NEAR - t_p) / w)
    # The last interval may lack its sample, or have more than is left.
    if density == 0:
        np.testing.assert_allclose(totals, lengths, atol=STEP * MASS / FLOOR)
    else:
        assert max(totals) < float(lengths.max()) + STEP * MASS / FLOOR


def test_depth_is_found_on_average_wherever_the_grid_puts_samples() -> None:
    """The deltas make the sum of sigma delta the integral of sigma over what is live, on the average over the
    jitter, however wrong the grid is."""
    field, grid = make(-6.0), half_full()
    some = grid.densities > 0
    grid.densities[some] = grid.densities[some].clip(1, 3)  # live everywhere, and no ray has too many samples
    rays_o, rays_d = (rays[:8] for rays in some_rays())
    sums = []
    for jitter in ((np.arange(64) + 0.5) / 64).tolist():
        samples, sigmas, _ = grid.march(field, rays_o, rays_d, torch.full((8,), jitter))
        inside = np.where(samples.t_mid.numpy() < 3, sigmas * samples.deltas.numpy(), 0)
        sums.append([part.sum() for part in np.split(inside, np.cumsum(samples.counts.numpy())[:-1])])
    found = np.mean(sums, axis=0)
    t = np.linspace(NEAR, 3, 20_001)
    t = (t[1:] + t[:-1]) / 2
    for ray in range(8):
        points = np.stack(
            [contract(point) for point in (rays_o[ray].numpy() + t[:, None] * rays_d[ray].numpy())]
        )
        points = ((points + 2) / 4).astype(np.float32)
        cells = (points * RESOLUTION).astype(int)
        live = grid.densities[tuple(cells.T)] > 0
        depth = (np.exp(field.log_densities(points)) * live).sum() * (3 - NEAR) / 20_000
        assert found[ray] == pytest.approx(depth, rel=0.15, abs=1e-4)


def test_an_empty_grid_has_no_samples_and_a_full_one_stops_where_it_is_opaque() -> None:
    grid = SpaceGrid(NEAR, seed=0)
    rays_o, rays_d = some_rays()
    grid.threshold = THRESHOLD
    nothing = grid.sample_all(make(), rays_o.numpy(), rays_d.numpy())
    assert len(nothing.t_mid) == 0 and nothing.counts.tolist() == [0] * len(rays_o)
    features, opacity, depth = grid.composited_features(make(), rays_o.numpy(), rays_d.numpy())
    assert not features.any() and not opacity.any() and not depth.any()
    grid.densities[:] = 3e38
    opaque = grid.sample_all(make(15.0), rays_o.numpy(), rays_d.numpy())
    assert opaque.counts.tolist() == [1] * len(rays_o)
    none = grid.sample_all(make(), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    assert len(none.t_mid) == 0 and len(none.counts) == 0


def test_a_field_that_is_not_finite_ends_the_ray() -> None:
    field, grid = make(), half_full()
    with torch.no_grad():
        field.density.out.bias.fill_(math.nan)
    rays_o, rays_d = some_rays()
    samples, sigmas, _ = grid.march(field, rays_o, rays_d, torch.zeros(len(rays_o)))
    assert int(samples.counts.max()) == 1 and np.isnan(sigmas).all()
    grid.observe(samples.points.numpy(), sigmas)
    assert not grid.gathered.any()


def test_what_the_grid_takes_for_opaque_is_looked_behind() -> None:
    """As long as the field itself lets light through."""
    field, grid = make(-12.0), SpaceGrid(NEAR, seed=0)
    grid.densities[:] = 1e4
    samples = grid.sample_all(field, np.zeros((1, 3), np.float32), np.float32([[1, 0, 0]]))
    assert int(samples.counts[0]) == FINER * MOST_SAMPLES
    behind = SpaceGrid(NEAR, seed=0)
    behind.threshold = THRESHOLD
    for cell in (80, 100):
        behind.densities[cell] = 1e4
    samples = behind.sample_all(field, np.zeros((1, 3), np.float32), np.float32([[1, 0, 0]]))
    # A step belongs to the cell of its middle, and is about half as long.
    cells = (samples.points[:, 0] * RESOLUTION).long()
    assert set(cells.tolist()) <= {79, 80, 81, 99, 100, 101} and {80, 100} <= set(cells.tolist())


def test_rendering_is_the_equation_over_the_samples() -> None:
    field, grid = make(), half_full()
    rays_o, rays_d = some_rays()
    features, opacity, depth = grid.composited_features(field, rays_o.numpy(), rays_d.numpy())
    samples = grid.sample_all(field, rays_o.numpy(), rays_d.numpy())
    with torch.no_grad():
        sigmas = field.density(samples.features) * samples.deltas
    for ray in range(0, 30, 3):
        rows = slice(int(samples.starts[ray]), int(samples.starts[ray] + samples.counts[ray]))
        out, alpha = composite_ray(sigmas[rows].numpy(), samples.features[rows].numpy(), 1.0)
        np.testing.assert_allclose(features[ray], out, rtol=0, atol=2e-6)
        assert opacity[ray] == pytest.approx(alpha, abs=2e-6)
        assert depth[ray] <= float(samples.t_mid[rows].max()) * 1.0001


def test_cells_rise_at_once_and_fall_slowly() -> None:
    densities, sums, counts = np.zeros((3, 4, 4, 4), np.float32)
    point = np.float32([[0.3, 0.6, 0.99]])
    met = ([8.0], 8.0), ([0.0, 4.0], 5.0), ([math.nan], 5.0), ([], 5.0), ([math.nan, 9.0], 9.0), ([9.0], 9.0)
    for sigmas, expected in met:
        gather(point.repeat(len(sigmas), 0), np.float32(sigmas), sums, counts)
        settle(sums, counts, np.float32(0.5), densities)
        assert densities[1, 2, 3] == pytest.approx(expected) and np.count_nonzero(densities) == 1
        assert not sums.any() and not counts.any()
    gather(np.float32([[1, 1, 1], [0, 0, 0]]), np.float32([1, 2]), sums, counts)
    assert sums[3, 3, 3] == 1 and sums[0, 0, 0] == 2 and counts.sum() == 2


def test_updates_find_what_the_field_has(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(space_grid, "SHARE", 2)
    field, grid = make(-4.0), SpaceGrid(NEAR, seed=0)
    grid.update(field)
    assert 0 < grid.threshold <= THRESHOLD
    middles = np.argwhere(np.ones((RESOLUTION,) * 3)) + 0.5 - RESOLUTION / 2
    inside = np.linalg.norm(middles, axis=1) < RESOLUTION / 2
    seen = grid.densities.reshape(-1)
    # Rounding may put a point at the border of a cell into the next.
    assert (seen[inside] > 0).mean() > 0.9999 and (seen[~inside] > 0).mean() < 1e-4
    with torch.no_grad():
        field.density.out.bias.fill_(2.0)
    before = seen.copy()
    for _ in range(4):
        grid.update(field)
    assert (seen[inside] > before[inside]).mean() > 0.9
    assert np.isfinite(seen).all()
    grid.observe(np.float32([[0.5, 0.5, 0.5]]), np.float32([3.0]))
    again = SpaceGrid(NEAR, seed=5)
    again.restore(grid.state())
    for each in (grid, again):
        each.update(field)
    np.testing.assert_array_equal(again.densities, grid.densities)
    assert again.threshold == grid.threshold


def test_what_surely_belongs_to_a_sample_is_a_step_at_most() -> None:
    field, grid = make(-20.0), SpaceGrid(NEAR, seed=0)
    rays_o, rays_d = (rays.numpy() for rays in some_rays())
    samples = grid.sample_all(field, rays_o, rays_d)
    lengths, t = steps_around(samples, rays_o, rays_d), samples.t_mid.numpy()
    assert (lengths > 0).all() and (lengths <= samples.deltas.numpy()).all() and (lengths <= np.abs(t)).all()
    first = samples.starts[30]  # from the origin along an axis: dt = (1 + t^2) dphi
    np.testing.assert_allclose(lengths[first], STEP * (1 + t[first] ** 2), rtol=1e-4)
