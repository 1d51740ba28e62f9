"""The occupancy grid of a training on a GPU: `vfr_bake.rendering.occupancy` with its arrays beside the field.

The march on a GPU tests every lattice point and needs no distances.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from vfr_bake.field.field import VfrField
from vfr_bake.rendering.occupancy import DECAY, OPACITY_THRESHOLD, SHARE, OccupancyGrid
from vfr_bake.torch_kernels.march import LOOKUP_POINTS


class DeviceOccupancyGrid:
    """`densities` [n, n, n] float32 per model unit and `occupied` [n, n, n] bool on `device`.

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
        """Look at the field at one random point of each of a share of the cells; the first time, of all."""
        n_cells, device = self.resolution**3, self.densities.device
        if self.n_updates == 0:
            cells = torch.arange(n_cells, device=device)
        else:
            cells = torch.randint(n_cells, (n_cells // SHARE,), generator=self._generator, device=device)
        self.densities *= DECAY
        for part in cells.split(LOOKUP_POINTS):
            self._raise(part, field.lookup(self._points(part))[1])
        self.n_updates += 1
        # A fog everywhere must not count as full: the mean bounds the threshold while the field is still
        # thin.
        threshold = self.densities.mean().clamp(max=float(-np.log1p(-OPACITY_THRESHOLD)) / self.step)
        occupied = self.densities > threshold
        self.occupied = occupied | ~occupied.any()  # nothing found yet: look everywhere rather than nowhere

    def _points(self, cells: Tensor) -> Tensor:
        """One random point [n, 3] of the unit cube in each of `cells` [n]."""
        n = self.resolution
        corner = torch.stack([cells // (n * n), cells // n % n, cells % n], dim=-1)
        inside = torch.rand(len(cells), 3, generator=self._generator, device=cells.device)
        return (corner + inside) / n

    def _raise(self, cells: Tensor, sigmas: Tensor) -> None:
        self.densities.view(-1).scatter_reduce_(0, cells, sigmas, "amax")

    def observe(self, points: Tensor, sigmas: Tensor) -> None:
        """Take the densities [n_points] that rays met at `points` [n_points, 3] of the unit cube: what they
        pass needs no look of its own."""
        n = self.resolution
        x, y, z = (points * n).long().clamp(0, n - 1).unbind(-1)
        self._raise((x * n + y) * n + z, sigmas)

    def on_cpu(self) -> OccupancyGrid:
        """The grid that pictures are rendered with and that the model file keeps."""
        grid = OccupancyGrid(self.resolution, self.step, seed=0)
        grid.set_occupied(self.occupied.cpu().numpy())
        return grid

    def state(self) -> dict[str, Any]:
        """All that the next update depends on, in tensors and plain values."""
        return {
            "densities": self.densities,
            "occupied": self.occupied,
            "n_updates": self.n_updates,
            "generator": self._generator.get_state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        self.densities.copy_(state["densities"])
        self.occupied = state["occupied"].to(self.densities.device)
        self.n_updates = state["n_updates"]
        self._generator.set_state(state["generator"])
