"""The hash grid compared with a float64 loop of the equation, its torch twin, and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.reference import hash_grid_feature
from tests.vfr_bake import twins
from vfr_bake.config import FieldConfig
from vfr_bake.field.hash_grid import GridLayout, HashGrid, level_resolutions

SMALL = FieldConfig(n_levels=5, base_resolution=3, max_resolution=40, log2_table_size=10)


def small_grid(dtype: torch.dtype) -> HashGrid:
    torch.manual_seed(1)
    grid = HashGrid(SMALL).to(dtype)
    torch.nn.init.uniform_(grid.table, -1, 1)
    return grid


HARD_POINTS = torch.tensor(
    [
        [0.0, 0.0, 0.0],
        [1.0, 1.0, 1.0],
        [1.0, 0.0, 0.5],
        [1e-30, 1e-8, 1 - 2**-24],
        [1 / 3, 2 / 3, 0.5],
        [np.nextafter(np.float32(0.5), np.float32(0)), 0.5, np.nextafter(np.float32(0.5), np.float32(1))],
    ],
    dtype=torch.float64,
)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_kernel_and_twin_match_the_equation(dtype: torch.dtype, tolerance: float) -> None:
    # float32: a position at resolution 40 carries 40 * 2^-24 of rounding per axis, on entries of size 1
    grid = small_grid(dtype)
    torch.manual_seed(0)
    points = torch.cat([HARD_POINTS, torch.rand(50, 3, dtype=torch.float64)]).to(dtype)
    table = grid.table.detach().double().numpy()
    expected = np.stack(
        [
            hash_grid_feature(p, table, grid.layout.resolutions, grid.layout.offsets, 2**10)
            for p in points.double().numpy()
        ]
    )
    np.testing.assert_allclose(grid(points).detach().numpy(), expected, rtol=0, atol=tolerance)
    np.testing.assert_allclose(twins.encode(grid, points).detach().numpy(), expected, rtol=0, atol=tolerance)


def test_gradient_matches_finite_differences_and_autograd() -> None:
    grid = small_grid(torch.float64)
    points = torch.rand(7, 3, dtype=torch.float64)
    torch.autograd.gradcheck(
        lambda table: torch.func.functional_call(grid, {"table": table}, (points,)),
        (grid.table,),
        fast_mode=True,
    )
    upstream = torch.randn(7, SMALL.n_channels, dtype=torch.float64)
    (ours,) = torch.autograd.grad(grid(points), grid.table, upstream)
    (twin,) = torch.autograd.grad(twins.encode(grid, points), grid.table, upstream)
    torch.testing.assert_close(ours, twin, rtol=0, atol=1e-12)


def test_gradient_lands_in_the_buffer_and_adds_up() -> None:
    grid = small_grid(torch.float32)
    points = torch.rand(11, 3)
    (once,) = torch.autograd.grad(grid(points).sum(), grid.table)
    grid.table.grad = torch.zeros_like(grid.table)
    grid(points).sum().backward()
    grid(points).sum().backward()
    torch.testing.assert_close(grid.table.grad, 2 * once)


def test_scatter_is_the_same_in_every_run() -> None:
    # Thousands of points share few entries: a race would lose additions.
    grid = small_grid(torch.float32)
    points = torch.rand(20_000, 3)
    (first,) = torch.autograd.grad(grid(points).sum(), grid.table)
    for _ in range(3):
        (again,) = torch.autograd.grad(grid(points).sum(), grid.table)
        assert torch.equal(first, again)
    assert first.sum().item() == pytest.approx(20_000 * SMALL.n_channels, rel=1e-4)


@pytest.mark.parametrize(
    ("n_levels", "millions"),
    [(16, 13), (32, 34)],  # table 2 of the paper
)
def test_the_papers_parameter_counts(n_levels: int, millions: int) -> None:
    scene = n_levels == 32
    # 34 M is "the number of levels x the number of voxels each level x the number of feature channels".
    layout = GridLayout(n_levels, 16, 4096, 19)
    count = n_levels * 2**19 * 2 if scene else layout.n_entries * 2
    assert round(count / 1e6) == millions


def test_no_point_at_all() -> None:
    assert small_grid(torch.float32)(torch.zeros(0, 3)).shape == (0, SMALL.n_channels)


def test_given_features_are_kept_and_still_send_their_gradient() -> None:
    grid = small_grid(torch.float32)
    points, features = torch.rand(4, 3), torch.full((4, SMALL.n_channels), 7.0)
    out = grid(points, features)
    assert torch.equal(out, features)
    (gradient,) = torch.autograd.grad(out.sum(), grid.table)
    assert gradient.abs().sum() > 0


def test_resolutions_are_geometric_and_end_at_the_finest() -> None:
    resolutions = level_resolutions(16, 16, 512)
    assert (resolutions[0], resolutions[-1], len(resolutions)) == (16, 512, 16)
    assert resolutions == sorted(set(resolutions))
