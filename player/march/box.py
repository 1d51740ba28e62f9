"""Rays meet the box: from origin and direction in the model frame to entry point and direction in grid
coordinates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.asset.grid import SparseGrid


class Entries(NamedTuple):
    """Rays in grid coordinates, from where they enter the box."""

    t: np.ndarray
    """[n] float32, t of the entry."""
    length: np.ndarray
    """[n] float32, way inside the box; <= 0 for a ray that misses it."""
    point: np.ndarray
    """[3, n] float32, entry point in cells."""
    direction: np.ndarray
    """[3, n] float32, cells per model unit."""
    step: np.float32
    """Model units between samples."""

    def at(self, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Grid coordinates [3, n_places] at `s` [n_places] behind the entries of the rays `ray`
        [n_places]."""
        return self.point[:, ray] + s * self.direction[:, ray]

    def distances(self, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        """t [n_places], model units."""
        return self.t[ray] + s

    def lengths(self, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Model units [n_places] that samples stand for: a step, wherever they are."""
        return np.full(len(ray), self.step)

    def pulled_back(self, gradients: np.ndarray, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        """`gradients` themselves: the box's axes are the model frame's."""
        return gradients


def enter_box(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray) -> Entries:
    """Rays to grid coordinates, each moved to where it enters the box (slabs; t >= 0).

    A ray parallel to a face is inside that slab, faces included, or misses.
    """
    size = np.float32(grid.resolution)
    t_in = np.zeros(len(rays_o), np.float32)
    t_out = np.full(len(rays_o), np.inf, np.float32)
    point = np.ascontiguousarray(((rays_o - grid.aabb_min) * grid.cells_per_unit).T)
    direction = np.ascontiguousarray((rays_d * grid.cells_per_unit).T)
    for o, d in zip(point, direction, strict=True):
        parallel = d == 0
        outside = parallel & ((o < 0) | (o > size))
        divisor = np.where(parallel, np.float32(1), d)
        with np.errstate(over="ignore"):  # nearly parallel: infinitely far away is the right answer
            a, b = (0 - o) / divisor, (size - o) / divisor
        t_in = np.where(parallel, t_in, np.maximum(t_in, np.minimum(a, b)))
        t_out = np.where(parallel, t_out, np.minimum(t_out, np.maximum(a, b)))
        t_out[outside] = -np.inf
    with np.errstate(over="ignore", invalid="ignore"):  # of rays that miss; nobody asks where
        point = np.clip(point + t_in * direction, np.float32(0), size)
    return Entries(t_in, t_out - t_in, point, direction, grid.step)
