"""The hash grid in torch compared with the float64 loop and the numba kernels, also as a graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from tests.reference import hash_grid_feature
from tests.vfr_bake.field.test_hash_grid import HARD_POINTS, SMALL, small_grid
from vfr_bake.field.hash_grid import GridLayout
from vfr_bake.torch_kernels.hash_grid import encode, features_at, scatter


def points(dtype: torch.dtype) -> torch.Tensor:
    torch.manual_seed(0)
    return torch.cat([HARD_POINTS, torch.rand(50, 3, dtype=torch.float64)]).to(dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_it_matches_the_equation(dtype: torch.dtype, tolerance: float, device: torch.device) -> None:
    # float32: a position at resolution 40 carries 40 * 2^-24 of rounding per axis, on entries of size 1
    grid = small_grid(dtype).to(device)
    table = grid.table.detach().cpu().double().numpy()
    layout = grid.layout
    expected = [
        hash_grid_feature(p, table, layout.resolutions, layout.offsets, 2**10)
        for p in points(dtype).double().numpy()
    ]
    ours = encode(points(dtype).to(device), grid.table, layout.levels(grid.table))
    np.testing.assert_allclose(ours.detach().cpu().numpy(), np.stack(expected), rtol=0, atol=tolerance)


def test_rows_of_large_hashed_levels_are_those_of_the_kernel(device: torch.device) -> None:
    """Rows of large hashed levels are the kernel's, also where its products wrap around in 32 bits."""
    torch.manual_seed(0)
    layout = GridLayout(2, 512, 8192, 12)
    table = torch.rand(layout.n_entries, 2, dtype=torch.float64)
    x = torch.rand(200, 3, dtype=torch.float64)
    expected = np.stack(
        [hash_grid_feature(p, table.numpy(), layout.resolutions, layout.offsets, 2**12) for p in x.numpy()]
    )
    ours = encode(x.to(device), table.to(device), layout.levels(table.to(device)))
    np.testing.assert_allclose(ours.cpu().numpy(), expected, rtol=0, atol=1e-10)


def test_its_gradient_is_the_kernels(device: torch.device) -> None:
    grid, x = small_grid(torch.float64), points(torch.float64)
    upstream = torch.randn(len(x), SMALL.n_channels, dtype=torch.float64)
    (expected,) = torch.autograd.grad(grid(x), grid.table, upstream)
    ours = small_grid(torch.float64).to(device)
    ours.backend = "torch"
    (gradient,) = torch.autograd.grad(ours(x.to(device)), ours.table, upstream.to(device))
    torch.testing.assert_close(gradient.cpu(), expected, rtol=0, atol=1e-12)


def test_given_features_are_kept_and_still_send_their_gradient(device: torch.device) -> None:
    grid = small_grid(torch.float32).to(device)
    x, known = torch.rand(4, 3, device=device), torch.full((4, SMALL.n_channels), 7.0, device=device)
    out = features_at(x, grid.table, grid.layout.levels(grid.table), known)
    assert torch.equal(out, known)
    (gradient,) = torch.autograd.grad(out.sum(), grid.table)
    assert gradient.sum().item() == pytest.approx(4 * SMALL.n_channels, rel=1e-5)


def test_no_point_at_all(device: torch.device) -> None:
    grid = small_grid(torch.float32).to(device)
    grid.backend = "torch"
    out = grid(torch.zeros(0, 3, device=device))
    assert out.shape == (0, SMALL.n_channels)
    (gradient,) = torch.autograd.grad(out.sum(), grid.table)
    assert gradient.shape == grid.table.shape and not gradient.any()


def test_one_graph_serves_all_numbers_of_points(device: torch.device) -> None:
    """One graph, without a break, serves every number of points, so that a GPU compiles only once."""
    grid = small_grid(torch.float32).to(device)
    levels = grid.layout.levels(grid.table)
    graphs = []

    def backend(graph: torch.fx.GraphModule, inputs: list[torch.Tensor]) -> Callable[..., Any]:
        graphs.append(graph)
        return graph.forward

    torch._dynamo.reset()
    forth = torch.compile(encode, backend=backend, fullgraph=True, dynamic=True)
    back = torch.compile(scatter, backend=backend, fullgraph=True, dynamic=True)
    for n in (7, 17, 300):
        x = torch.rand(n, 3, device=device)
        upstream = torch.randn(n, SMALL.n_channels, device=device)
        torch.testing.assert_close(forth(x, grid.table, levels), encode(x, grid.table, levels))
        expected = scatter(x, upstream, len(grid.table), levels)
        torch.testing.assert_close(back(x, upstream, len(grid.table), levels), expected)
    assert len(graphs) == 2
