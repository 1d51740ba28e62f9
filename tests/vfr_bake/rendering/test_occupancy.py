"""The occupancy grid: it finds what is dense, forgets what is gone, and never loses sight of all matter."""

from __future__ import annotations

import numpy as np

from vfr_bake.rendering.occupancy import OccupancyGrid


class Ball:
    """Stand-in for a field: dense inside a ball in the unit cube."""

    def __init__(self, centre: float) -> None:
        self.centre = centre

    def log_densities(self, points: np.ndarray) -> np.ndarray:
        inside = np.linalg.norm(points - np.array([self.centre, 0.5, 0.5]), axis=-1) < 0.2
        return np.where(inside, 5.0, -20.0)


def inside_cells(centre: float, n: int = 24) -> np.ndarray:
    """Return the cells whose centre is well inside the ball, [n, n, n] bool."""
    x = (np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1) + 0.5) / n
    return np.linalg.norm(x - np.array([centre, 0.5, 0.5]), axis=-1) < 0.2 - 1 / n


def test_before_any_look_everything_may_be_occupied() -> None:
    assert OccupancyGrid(24, step=0.01, seed=0).occupied.all()


def test_the_first_look_finds_the_ball_and_little_else() -> None:
    grid = OccupancyGrid(24, step=0.01, seed=0)
    grid.update(Ball(0.4))  # type: ignore[arg-type]
    assert grid.occupied[inside_cells(0.4)].all()
    assert grid.occupied.mean() < 0.06, "the ball has 3.4 % of the volume, its rim included about 5 %"


def test_what_moved_away_fades_and_what_came_is_found() -> None:
    grid = OccupancyGrid(24, step=0.01, seed=0)
    grid.update(Ball(0.3))  # type: ignore[arg-type]
    random = np.random.default_rng(0)
    ball = Ball(0.7)
    for _ in range(200):
        grid.update(ball)  # type: ignore[arg-type]
        points = random.random((2000, 3)).astype(np.float32)  # rays sample occupied cells only
        points = points[grid.occupied[tuple((points * 24).astype(int).T)]]
        grid.observe(points, np.exp(ball.log_densities(points)))
    assert not grid.occupied[inside_cells(0.3)].any()
    assert grid.occupied[inside_cells(0.7)].mean() > 0.95


def test_what_rays_meet_counts_as_looked_at() -> None:
    grid = OccupancyGrid(24, step=0.01, seed=0)
    grid.update(Ball(0.4))  # type: ignore[arg-type]
    # Two samples lie in one cell: the denser one counts. The cube's far corner belongs to the last cell.
    points = np.float32([[0.95, 0.05, 0.5], [0.951, 0.05, 0.5], [1.0, 1.0, 1.0]])
    grid.observe(points, np.float32([200.0, 30.0, 200.0]))
    assert grid.densities[22, 1, 12] == 200 and grid.densities[23, 23, 23] == 200
    grid.update(Ball(0.4))  # type: ignore[arg-type]
    assert grid.occupied[22, 1, 12] and grid.occupied[23, 23, 23]
    assert not grid.occupied[21, 1, 12]


def test_a_field_without_matter_is_looked_at_everywhere() -> None:
    grid = OccupancyGrid(24, step=0.01, seed=0)
    grid.update(Ball(9.0))  # type: ignore[arg-type]
    assert grid.occupied.all()
