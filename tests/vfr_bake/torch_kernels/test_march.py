"""The march in torch compared with its slow twin and the numba kernel, and its promises."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.vfr_bake import twins
from tests.vfr_bake.rendering.test_march import STEP, field_of_density, half_full, rays
from vfr_bake.field.field import VfrField
from vfr_bake.rendering import sampling
from vfr_bake.rendering.compositing import RaySamples
from vfr_bake.torch_kernels.march import lattice


def on(device: torch.device, logit: float) -> VfrField:
    field = field_of_density(logit).to(device)
    field.grid.backend = "torch"
    return field


def march(
    logit: float, occupied: np.ndarray, budget: int, device: torch.device, n: int | None = None
) -> RaySamples:
    """March the first `n` test rays; all returned tensors are on the CPU."""
    rays_o, rays_d = (a[:n].to(device) for a in rays())
    cells = torch.from_numpy(occupied).to(device)
    samples = sampling.march_on_device(
        on(device, logit).lookup, cells, STEP, rays_o, rays_d, jitters()[: len(rays_o)].to(device), budget
    )
    tensors = {name: value.cpu() for name, value in vars(samples).items() if value is not None}
    return RaySamples(**tensors)


def jitters() -> torch.Tensor:
    return torch.rand(len(rays()[0]), generator=torch.Generator().manual_seed(4))


@pytest.mark.parametrize("logit", [-9.0, 1.0, 3.5])
def test_it_finds_what_the_twin_and_the_kernel_find(logit: float, device: torch.device) -> None:
    field, occupancy = field_of_density(logit), half_full()
    rays_o, rays_d = rays()
    samples = march(logit, occupancy.occupied, 200_000, device)
    expected = twins.march(field, occupancy.occupied, rays_o, rays_d, jitters(), STEP)
    compiled = sampling.march(field, occupancy.distance, STEP, rays_o, rays_d, jitters(), 200_000, n_chunks=1)
    assert samples.rays.tolist() == list(range(len(rays_o)))
    n_different = 0
    for ray, t in enumerate(expected):
        found = samples.t_mid[samples.starts[ray] : samples.starts[ray] + samples.counts[ray]]
        if len(found) == len(t):
            torch.testing.assert_close(found, t, rtol=0, atol=2e-6)
        else:  # a sample within rounding of a cell border may fall on either side of it
            n_different += abs(len(found) - len(t))
    assert n_different <= 2
    assert abs(len(samples.t_mid) - len(compiled.t_mid)) <= 2
    assert len(samples.t_mid) > 200 and (samples.deltas == STEP).all()
    torch.testing.assert_close(samples.features, twins.encode(field.grid, samples.points), rtol=0, atol=1e-5)
    torch.testing.assert_close(samples.sigmas, field.density(samples.features).detach(), rtol=1e-5, atol=0)


def test_it_does_not_depend_on_the_size_of_its_blocks(
    device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = march(1.0, half_full().occupied, 200_000, device)
    monkeypatch.setattr(sampling, "LATTICE_POINTS", 500)
    monkeypatch.setattr(sampling, "LOOKUP_POINTS", 7)
    parts = march(1.0, half_full().occupied, 200_000, device)
    for name, value in vars(whole).items():
        torch.testing.assert_close(getattr(parts, name), value, msg=name)


def test_the_budget_holds_and_serves_whole_rays(
    device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = np.ones((16, 16, 16), bool)
    whole = march(-9.0, full, 200_000, device)
    for block in (2**22, 500):
        monkeypatch.setattr(sampling, "LATTICE_POINTS", block)
        samples = march(-9.0, full, 300, device)
        n, n_rays = len(samples.t_mid), len(samples.rays)
        assert 0 < n <= 300 and 0 < n_rays < len(whole.rays)
        assert int(whole.counts[: n_rays + 1].sum()) > 300, "the next ray would not have fitted"
        assert n == int(samples.counts.sum()) == len(samples.sigmas) == len(samples.points)
        assert torch.equal(samples.t_mid, whole.t_mid[:n])


def test_an_opaque_field_stops_at_its_first_samples(device: torch.device) -> None:
    samples = march(12.0, np.ones((16, 16, 16), bool), 100_000, device)
    assert int(samples.counts.max()) == 1


def test_no_ray_and_rays_that_meet_nothing(device: torch.device) -> None:
    none = march(1.0, half_full().occupied, 1000, device, n=0)
    assert len(none.rays) == len(none.t_mid) == len(none.sigmas) == 0 and none.features.shape == (0, 8)
    nothing = march(1.0, np.zeros((16, 16, 16), bool), 1000, device)
    assert len(nothing.rays) == len(rays()[0]) and not nothing.counts.any()


def test_a_lattice_is_one_graph(device: torch.device) -> None:
    rays_o, rays_d = (a.to(device) for a in rays())
    occupied = torch.from_numpy(half_full().occupied).to(device)
    torch._dynamo.reset()
    graph = torch.compile(lattice, backend="aot_eager", fullgraph=True, dynamic=True)
    arguments = (rays_o, rays_d, jitters().to(device), occupied, STEP, 97)
    for ours, expected in zip(graph(*arguments), lattice(*arguments), strict=True):
        torch.testing.assert_close(ours, expected)
