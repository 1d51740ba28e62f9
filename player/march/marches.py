"""Samples along rays through either kind of grid: the box of an object, or all of space, contracted."""

from __future__ import annotations

import numpy as np

from player.asset.grid import SparseGrid
from player.march import contracted_march, march
from player.march.box import enter_box
from player.march.contracted import enter_space
from player.march.fetches import Places, Samples


def sampled_rays(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[Places, Samples, np.ndarray]:
    """Rays in grid coordinates, all their samples with weight, and tau [n] of each; by the numpy marches.

    Args:
        grid: the sparse grid.
        rays_o: [n, 3] float32 origins, model frame.
        rays_d: [n, 3] float32 unit directions, model frame.
        bounds: optional [n] float32 `near` and `far` in a box, as for `player.march.march.march`.
    """
    if grid.contracted:
        rays = enter_space(grid, rays_o, rays_d)
        samples, tau, _ = contracted_march.collect_samples(grid, rays)
        return rays, samples, tau
    entries = enter_box(grid, rays_o, rays_d)
    samples, tau, _ = march.collect_samples(grid, entries, bounds)
    return entries, samples, tau
