"""The compiled march compared with its slow twin, and its promises about budgets and order."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.vfr_bake import twins
from vfr_bake.config import FieldConfig
from vfr_bake.field.field import VfrField
from vfr_bake.kernels.march import chebyshev_distance
from vfr_bake.rendering.compositing import composite
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.rendering.sampling import march

STEP = 0.037
CONFIG = FieldConfig(n_levels=4, base_resolution=4, max_resolution=32, log2_table_size=12, head_width=16)


def field_of_density(logit: float) -> VfrField:
    torch.manual_seed(0)
    field = VfrField(CONFIG)
    torch.nn.init.uniform_(field.grid.table, -1, 1)
    with torch.no_grad():
        field.density.out.bias.fill_(logit)
    return field


def half_full(seed: int = 0) -> OccupancyGrid:
    occupancy = OccupancyGrid(16, STEP, seed=0)
    occupancy.set_occupied(np.random.default_rng(seed).random((16, 16, 16)) < 0.15)
    return occupancy


def rays(n: int = 60) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    origins = torch.randn(n, 3, generator=generator) * 1.5
    targets = torch.rand(n, 3, generator=generator) - 0.5
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    hard = [
        ([-2, 0.1, 0.2], [1, 0, 0]),  # along an axis
        ([0.3, 0.3, 3], [0.0, -0.0, -1]),  # with -0.0
        ([0, 0, 0], [0, 1, 0]),  # from inside, on a cell border
        ([1, 0.5, 0.5], [-1, 0, 0]),  # from a face inwards
        ([1, 0.5, 0.5], [1, 0, 0]),  # from a face outwards
        ([-2, 1.5, 0], [1, 0, 0]),  # parallel to a face, outside
        ([5, 5, 5], [0.57735026, 0.57735026, 0.57735026]),  # box behind the origin
        ([-2, -2, -2], [0.57735026, 0.57735026, 0.57735026]),  # through two corners
    ]
    extra_o = torch.tensor([o for o, _ in hard], dtype=torch.float32)
    extra_d = torch.tensor([d for _, d in hard], dtype=torch.float32)
    return torch.cat([origins, extra_o]), torch.cat([directions, extra_d])


@pytest.mark.parametrize("logit", [-9.0, 1.0, 3.5])
def test_march_finds_what_the_twin_finds(logit: float) -> None:
    field, occupancy = field_of_density(logit), half_full()
    rays_o, rays_d = rays()
    jitter = torch.rand(len(rays_o), generator=torch.Generator().manual_seed(4))
    samples = march(field, occupancy.distance, STEP, rays_o, rays_d, jitter, 200_000)
    expected = twins.march(field, occupancy.occupied, rays_o, rays_d, jitter, STEP)
    assert samples.rays.tolist() == list(range(len(rays_o)))
    n_different = 0
    for ray, t in enumerate(expected):
        start, count = samples.starts[ray], samples.counts[ray]
        found = samples.t_mid[start : start + count]
        if len(found) == len(t):
            torch.testing.assert_close(found, t, rtol=0, atol=2e-6)
        else:  # a sample within rounding of a cell border may fall on either side of it
            n_different += abs(len(found) - len(t))
    assert n_different <= 2
    assert len(samples.t_mid) > 200
    torch.testing.assert_close(samples.features, twins.encode(field.grid, samples.points), rtol=0, atol=1e-5)
    np.testing.assert_allclose(samples.sigmas, field.density(samples.features).detach().numpy(), rtol=1e-5)


def test_nothing_is_written_past_the_budget() -> None:
    field, occupancy = field_of_density(-9.0), OccupancyGrid(16, STEP, seed=0)
    rays_o, rays_d = rays(400)
    jitter = torch.zeros(len(rays_o))
    samples = march(field, occupancy.distance, STEP, rays_o, rays_d, jitter, 1000, n_chunks=2)
    assert 0 < len(samples.t_mid) <= 1000
    assert len(samples.rays) < len(rays_o)
    assert int(samples.counts.sum()) == len(samples.t_mid)
    whole = march(field, occupancy.distance, STEP, rays_o, rays_d, jitter, 400_000, n_chunks=2)
    for ray, start, count in zip(samples.rays, samples.starts, samples.counts, strict=True):
        first = int(whole.starts[ray])
        assert torch.equal(samples.t_mid[start : start + count], whole.t_mid[first : first + int(count)])


def test_rendering_without_stored_samples_equals_rendering_with_them() -> None:
    field, occupancy = field_of_density(2.0), half_full()
    rays_o, rays_d = rays()
    samples = march(field, occupancy.distance, STEP, rays_o, rays_d, torch.full((len(rays_o),), 0.5), 200_000)
    with torch.no_grad():
        sigmas = field.density(samples.features)
        out, opacity, _ = composite(sigmas, samples.features, samples.deltas, samples.starts, samples.counts)
    features, alpha = occupancy.composited_features(field, rays_o.numpy(), rays_d.numpy())
    np.testing.assert_allclose(features, out.numpy(), rtol=0, atol=2e-5)
    np.testing.assert_allclose(alpha, opacity.numpy(), rtol=0, atol=2e-6)


def test_an_opaque_field_stops_at_its_first_samples() -> None:
    field, occupancy = field_of_density(12.0), OccupancyGrid(16, STEP, seed=0)
    rays_o, rays_d = rays()
    samples = march(field, occupancy.distance, STEP, rays_o, rays_d, torch.zeros(len(rays_o)), 100_000)
    assert int(samples.counts.max()) == 1


def test_distance_field_is_the_chebyshev_distance() -> None:
    random = np.random.default_rng(1)
    occupied = random.random((9, 9, 9)) < 0.02
    occupied[4, 4, 4] = True
    distance = np.zeros((9, 9, 9), np.uint8)
    chebyshev_distance(occupied, distance)
    cells, full = np.argwhere(np.ones_like(occupied)), np.argwhere(occupied)
    expected = np.abs(cells[:, None] - full[None]).max(axis=-1).min(axis=1)
    assert np.array_equal(distance.reshape(-1), expected)
