"""The occupancy grid: it finds what is dense, forgets what went, and never goes blind."""

from __future__ import annotations

import numpy as np

from vfr_bake.rendering.occupancy import OccupancyGrid


class Ball:
    """Stands for a field: dense inside a ball of the unit cube."""

    def __init__(self, centre: float) -> None:
        self.centre = centre

    def log_densities(self, points: np.ndarray) -> np.ndarray:
        inside = np.linalg.norm(points - np.array([self.centre, 0.5, 0.5]), axis=-1) < 0.2
        return np.where(inside, 5.0, -20.0)


def inside_cells(centre: float, n: int = 24) -> np.ndarray:
    """[n, n, n] bool: cells whose centre is well inside the ball."""
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
    for _ in range(200):
        grid.update(Ball(0.7))  # type: ignore[arg-type]
    assert not grid.occupied[inside_cells(0.3)].any()
    assert grid.occupied[inside_cells(0.7)].mean() > 0.95


def test_a_field_without_matter_is_looked_at_everywhere() -> None:
    grid = OccupancyGrid(24, step=0.01, seed=0)
    grid.update(Ball(9.0))  # type: ignore[arg-type]
    assert grid.occupied.all()
