"""Occupancy grid: records which cells of the box may hold matter, so that the march skips the others.

As in instant-ngp and nerfacc, each cell keeps a moving maximum of the density: it decays, is raised where the
field is dense, and is compared with a threshold on the opacity of one march step.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from vfr_bake.field.field import VfrField
from vfr_bake.kernels.density import LIMITS
from vfr_bake.kernels.march import chebyshev_distance, render_features
from vfr_bake.rendering.compositing import RaySamples
from vfr_bake.rendering.sampling import LOOKUP_POINTS, march, most_samples

OPACITY_THRESHOLD = 0.03
"""Opacity of a whole step of a training's march below which a cell counts as empty. With nerfacc's default of
0.01 the haze around surfaces takes half of a batch's samples: lego after 1,500 steps had 23.4 dB with 0.01,
24.1 with 0.03 and 24.4 with 0.12, but a thin fog would not survive 0.12."""
TRAINING_STEPS = 2
"""Number of a picture's march steps in one step of a training's march. In training every ray begins its steps
at random, so that a field learns what long steps show on average. Pictures with short steps show nearly that,
half a decibel better than with long ones (docs/notes/2026-11-27-sharper-objects.md)."""
DECAY = 0.95
"""Factor by which all cells fade at an update, so that a cell stays occupied only if a recent
look found matter in it."""
SHARE = 32
"""An update looks at one random cell in this many; the others are left to the rays that pass through
them. With 64, matter that appears in a cell that counts as empty is found too late (lego after 1,200
steps: 1.0 dB less). With 8, more cells stay occupied, and a batch of a given number of samples holds
fewer rays (0.9 dB less)."""


def empty_below(step: float) -> float:
    """Return the density, 1/model unit, below which a cell is empty if pictures are marched with `step`.

    >>> round(empty_below(0.01), 3)
    1.523
    """
    return float(-np.log1p(-OPACITY_THRESHOLD)) / (TRAINING_STEPS * step)


class OccupancyGrid:
    """Occupancy grid on a CPU. `densities` [n, n, n] float32 are per model unit. `distance` [n, n, n] uint8
    is the distance in cells to the nearest occupied cell, for the march. `step` is the length of a
    picture's steps, model units.

    >>> grid = OccupancyGrid(16, step=0.01, seed=0)
    >>> int(grid.distance.max())
    0
    """

    def __init__(self, resolution: int, step: float, seed: int) -> None:
        self.resolution = resolution
        self.step = step
        self.densities = np.full((resolution,) * 3, np.inf, np.float32)
        self.distance = np.zeros((resolution,) * 3, np.uint8)
        self.n_updates = 0
        self._random = np.random.default_rng(seed)

    @property
    def occupied(self) -> np.ndarray:
        """True for cells that may hold matter, [n, n, n] bool."""
        return self.distance == 0

    def update(self, field: VfrField) -> None:
        """Look up the field at one random point of each cell in a random share of the cells; the
        first time, in all cells."""
        n_cells = self.resolution**3
        flat = self.densities.reshape(-1)
        if self.n_updates == 0:
            cells = np.arange(n_cells)
            flat[:] = 0
        else:
            # One cell of every SHARE successive ones: ascending without a sort, for fast access to memory.
            first = np.arange(0, n_cells, SHARE)
            cells = np.minimum(first + self._random.integers(0, SHARE, len(first)), n_cells - 1)
        flat *= DECAY
        flat[cells] = np.maximum(flat[cells], self._sample(field, cells))
        self.n_updates += 1
        # The mean bounds the threshold while the field is still a thin fog: if no cell were above it, the
        # march would visit all cells.
        threshold = min(empty_below(self.step), float(flat.mean()))
        self.set_occupied(self.densities > threshold)

    def observe(self, points: np.ndarray, sigmas: np.ndarray) -> None:
        """Raise the cells at `points` [n_points, 3] of the unit cube to the densities [n_points] that rays
        met there, so that an update need not look at these cells."""
        n = self.resolution
        x, y, z = np.minimum((points * np.float32(n)).astype(np.int64), n - 1).T
        np.maximum.at(self.densities.reshape(-1), (x * n + y) * n + z, sigmas)

    def _sample(self, field: VfrField, cells: np.ndarray) -> np.ndarray:
        n = self.resolution
        corner = np.stack(np.unravel_index(cells, (n, n, n)), axis=-1)
        points = (corner + self._random.random((len(cells), 3))) / n
        return np.exp(field.log_densities(points.astype(np.float32)))

    def set_occupied(self, occupied: np.ndarray) -> None:
        """Let the march visit the cells of `occupied` [n, n, n] bool, or all cells if none is occupied."""
        if not occupied.any():
            occupied = np.ones_like(occupied)  # nothing found yet: look everywhere rather than nowhere
        chebyshev_distance(occupied, self.distance)

    def composited_features(
        self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Composite the field's features along rays `rays_o`, `rays_d` [n_rays, 3], with a lookup at every
        sample; return (features [n_rays, n_channels], opacity [n_rays])."""
        features = np.zeros((len(rays_o), field.config.n_channels), np.float32)
        opacity = np.zeros(len(rays_o), np.float32)
        step = np.float32(self.step)
        render_features(rays_o, rays_d, step, self.distance, field.arrays(), LIMITS, features, opacity)
        return features, opacity

    def sample_all(self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray) -> RaySamples:
        """Return the samples of all rays, in the middle of their intervals."""
        middle = torch.full((len(rays_o),), 0.5)
        rays = torch.from_numpy(rays_o), torch.from_numpy(rays_d)
        return march(field, self.distance, self.step, *rays, middle, len(rays_o) * most_samples(self.step))

    def state(self) -> dict[str, Any]:
        """Return all that the next update depends on, in tensors and plain values."""
        return {
            "densities": torch.from_numpy(self.densities),
            "occupied": torch.from_numpy(self.occupied),
            "n_updates": self.n_updates,
            "random": self._random.bit_generator.state,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.densities[:] = state["densities"].numpy()
        self.n_updates = state["n_updates"]
        self._random.bit_generator.state = state["random"]
        self.set_occupied(state["occupied"].numpy())


class DeviceOccupancyGrid:
    """Occupancy grid on `device`. `densities` [n, n, n] float32 are per model unit, `occupied` is [n, n, n]
    bool, and `step` is that of `OccupancyGrid`.

    The march on a GPU tests every lattice point and needs no distances.

    >>> grid = DeviceOccupancyGrid(16, step=0.01, seed=0, device=torch.device("cpu"))
    >>> bool(grid.occupied.all())
    True
    """

    def __init__(self, resolution: int, step: float, seed: int, device: torch.device) -> None:
        self.resolution, self.step = resolution, step
        self.densities = torch.zeros((resolution,) * 3, device=device)
        self.occupied = torch.ones((resolution,) * 3, dtype=torch.bool, device=device)
        self.n_updates = 0
        self._generator = torch.Generator(device).manual_seed(seed)

    @torch.no_grad()
    def update(self, field: VfrField) -> None:
        """Look up the field at one random point of each cell in a random share of the cells; the
        first time, in all cells."""
        n_cells, device = self.resolution**3, self.densities.device
        if self.n_updates == 0:
            cells = torch.arange(n_cells, device=device)
        else:
            cells = torch.randint(n_cells, (n_cells // SHARE,), generator=self._generator, device=device)
        self.densities *= DECAY
        for part in cells.split(LOOKUP_POINTS):
            self._raise(part, field.lookup(self._points(part))[1])
        self.n_updates += 1
        # The mean bounds the threshold while the field is still a thin fog: if no cell were above it, the
        # march would visit all cells.
        threshold = self.densities.mean().clamp(max=empty_below(self.step))
        occupied = self.densities > threshold
        self.occupied = occupied | ~occupied.any()  # nothing found yet: look everywhere rather than nowhere

    def _points(self, cells: Tensor) -> Tensor:
        """Return one random point of the unit cube in each of `cells` [n], [n, 3]."""
        n = self.resolution
        corner = torch.stack([cells // (n * n), cells // n % n, cells % n], dim=-1)
        inside = torch.rand(len(cells), 3, generator=self._generator, device=cells.device)
        return (corner + inside) / n

    def _raise(self, cells: Tensor, sigmas: Tensor) -> None:
        self.densities.view(-1).scatter_reduce_(0, cells, sigmas, "amax")

    def observe(self, points: Tensor, sigmas: Tensor) -> None:
        """Raise the cells at `points` [n_points, 3] of the unit cube to the densities [n_points] that rays
        met there, so that an update need not look at these cells."""
        n = self.resolution
        x, y, z = (points * n).long().clamp(0, n - 1).unbind(-1)
        self._raise((x * n + y) * n + z, sigmas)

    def on_cpu(self) -> OccupancyGrid:
        """Return the grid that pictures are rendered with and that the model file keeps."""
        grid = OccupancyGrid(self.resolution, self.step, seed=0)
        grid.set_occupied(self.occupied.cpu().numpy())
        return grid

    def state(self) -> dict[str, Any]:
        """Return all that the next update depends on, in tensors and plain values."""
        return {
            "densities": self.densities,
            "occupied": self.occupied,
            "n_updates": self.n_updates,
            "generator": self._generator.get_state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.densities.copy_(state["densities"])
        self.occupied = state["occupied"].to(self.densities.device)
        self.n_updates = state["n_updates"]
        self._generator.set_state(state["generator"])
