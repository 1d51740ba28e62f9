"""The occupancy grid on a GPU finds and forgets as the CPU's does, and continues from its state."""

from __future__ import annotations

import numpy as np
import torch

from tests.vfr_bake.rendering.test_occupancy import inside_cells
from vfr_bake.rendering.occupancy import DeviceOccupancyGrid


class Ball:
    """Stand-in for a field: dense inside a ball in the unit cube."""

    def __init__(self, centre: float) -> None:
        self.centre = centre

    def lookup(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        centre = torch.tensor([self.centre, 0.5, 0.5], device=points.device)
        inside = torch.linalg.vector_norm(points - centre, dim=-1) < 0.2
        return points, torch.where(inside, np.exp(5.0), np.exp(-20.0)).to(points.dtype)


def grid_on(device: torch.device) -> DeviceOccupancyGrid:
    return DeviceOccupancyGrid(24, step=0.01, seed=0, device=device)


def occupied(grid: DeviceOccupancyGrid) -> np.ndarray:
    return grid.occupied.cpu().numpy()


def test_the_first_look_finds_the_ball_and_little_else(device: torch.device) -> None:
    grid = grid_on(device)
    grid.update(Ball(0.4))  # type: ignore[arg-type]
    assert occupied(grid)[inside_cells(0.4)].all()
    assert occupied(grid).mean() < 0.06, "the ball has 3.4 % of the volume, its rim included about 5 %"
    assert np.array_equal(grid.on_cpu().occupied, occupied(grid))


def test_what_moved_away_fades_and_what_came_is_found(device: torch.device) -> None:
    grid, ball = grid_on(device), Ball(0.7)
    grid.update(Ball(0.3))  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        grid.update(ball)  # type: ignore[arg-type]
        points = torch.rand(2000, 3, generator=generator).to(device)  # rays sample occupied cells only
        points = points[grid.occupied[tuple((points * 24).long().T)]]
        grid.observe(points, ball.lookup(points)[1])
    assert not occupied(grid)[inside_cells(0.3)].any()
    assert occupied(grid)[inside_cells(0.7)].mean() > 0.95


def test_what_rays_meet_counts_as_looked_at(device: torch.device) -> None:
    grid = grid_on(device)
    grid.update(Ball(0.4))  # type: ignore[arg-type]
    # Two samples lie in one cell: the denser one counts. The cube's far corner belongs to the last cell.
    points = torch.tensor([[0.95, 0.05, 0.5], [0.951, 0.05, 0.5], [1.0, 1.0, 1.0]], device=device)
    grid.observe(points, torch.tensor([200.0, 30.0, 200.0], device=device))
    assert grid.densities[22, 1, 12] == 200 and grid.densities[23, 23, 23] == 200
    grid.update(Ball(0.4))  # type: ignore[arg-type]
    assert occupied(grid)[22, 1, 12] and occupied(grid)[23, 23, 23] and not occupied(grid)[21, 1, 12]


def test_a_field_without_matter_is_looked_at_everywhere(device: torch.device) -> None:
    grid = grid_on(device)
    grid.update(Ball(9.0))  # type: ignore[arg-type]
    assert grid.occupied.all()


def test_it_goes_on_from_its_state(device: torch.device) -> None:
    grids = [grid_on(device), grid_on(device)]
    grids[0].update(Ball(0.4))  # type: ignore[arg-type]
    grids[1].restore({k: v.clone() if hasattr(v, "clone") else v for k, v in grids[0].state().items()})
    for grid in grids:
        grid.update(Ball(0.6))  # type: ignore[arg-type]
    assert torch.equal(grids[0].densities, grids[1].densities)
    assert torch.equal(grids[0].occupied, grids[1].occupied)
