"""Rays through a box: where they enter it, and the lattice of samples on them.

A position on a ray is given by s, the distance from the entry point in model units. The middle of base step i
is at `s_i = (i + 1/2) step`, wherever the ray enters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.asset.grid import SparseGrid

SKIP_MARGIN = np.float32(0.01)
"""Cells by which a jump ends inside the region that is known to be empty: a hundred times the rounding error
of a grid coordinate."""


ONE = np.array(1, np.int32)
"""The size of a sample that stands for one base step."""

Bounds = tuple[np.ndarray, np.ndarray]
"""`near` and `far`, [n] float32: for each of n rays, the t outside which the caller knows that there is no
live cell."""


class BoxPath(NamedTuple):
    """The path of n rays through the box, from where they enter it; `player.march.path` describes the
    methods."""

    t: np.ndarray
    """[n] float32, t of the entry, model units."""
    first: np.ndarray
    """[n] int32, the first base step whose middle may lie in a live cell."""
    length: np.ndarray
    """[n] float32, s where the ray ends; <= 0 for a ray that misses the box."""
    point: np.ndarray
    """[3, n] float32, entry point in cells."""
    direction: np.ndarray
    """[3, n] float32, cells per model unit."""
    step: np.float32
    """Length of a base step, model units."""

    def sample(self, i: np.ndarray, size: np.ndarray = ONE) -> np.ndarray:
        return (i.astype(np.float32) + size.astype(np.float32) * np.float32(0.5)) * self.step

    def place(self, ray: np.ndarray, i: np.ndarray, size: np.ndarray = ONE) -> np.ndarray:
        return self.at(ray, self.sample(i, size))

    def jump(
        self, ray: np.ndarray, i: np.ndarray, g: np.ndarray, brick: np.ndarray, reach: np.ndarray
    ) -> np.ndarray:
        direction = self.direction.take(ray, axis=1)
        ahead, behind = (brick + (reach + 1)) * 8 - SKIP_MARGIN, (brick - reach) * 8 + SKIP_MARGIN
        still = direction == 0
        face = np.where(direction > 0, ahead, behind).astype(np.float32)
        s = (face - self.point.take(ray, axis=1)) / np.where(still, np.float32(1), direction)
        s[still] = np.inf
        # s is far below 0 where the point is within the margin of a face that the ray is nearly parallel to
        left = np.clip(s.min(axis=0), np.float32(0), np.float32(1e6)) / self.step - np.float32(0.5)
        return np.maximum(i, np.floor(np.minimum(left, np.float32(1e9))).astype(np.int32)) + 1

    def way(self, ray: np.ndarray, i: np.ndarray, size: np.ndarray = ONE) -> np.ndarray:
        return size.astype(np.float32) * self.step

    def at(self, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        return self.point.take(ray, axis=1) + s * self.direction.take(ray, axis=1)

    def distances(self, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        return self.t[ray] + s

    def pulled_back(self, gradients: np.ndarray, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        return gradients  # the box's axes are the model frame's


def enter_box(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    bounds: Bounds | None = None,
) -> BoxPath:
    """Find where rays enter the box (slab method; t >= 0), in grid coordinates.

    A ray that is parallel to a face is inside that slab, faces included, or misses the box.

    Args:
        grid: the sparse grid.
        rays_o: [n, 3] float32 origins, model frame.
        rays_d: [n, 3] float32 unit directions, model frame.
        bounds: bounds of t between which live cells can be, if they are known.
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
    with np.errstate(over="ignore", invalid="ignore"):  # for rays that miss: their values are not used
        point = np.clip(point + t_in * direction, np.float32(0), size)
        length = np.minimum(t_out - t_in, np.float32(grid.most_samples - 1) * grid.step)
    first = np.zeros(len(rays_o), np.int32)
    if bounds is not None:
        near, far = bounds
        ahead = np.maximum(near - t_in, 0) / grid.step - np.float32(0.5)
        first = np.maximum(np.floor(np.minimum(ahead, np.float32(1e9))), 0).astype(np.int32)
        first &= -grid.most_steps  # a step that every march visits, wherever it begins
        length = np.minimum(length, far - t_in)
    return BoxPath(t_in, first, length, point, direction, grid.step)
