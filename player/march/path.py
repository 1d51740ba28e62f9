"""The path of rays through a grid: the only part of the march in which an object's box and contracted space
differ.

A path holds n rays. On each lies a lattice of base steps that depends on the ray alone, so that skipping
empty space never changes a picture. A position on a ray is a number s >= 0 that rises along the ray. A path
has `first` [n], the first base step of each ray to look at, `length` [n], the s at which each ray ends, and
the methods below. Their arguments `ray` are indices of rays, `i` numbers of base steps and `s` positions, of
shapes that broadcast:

- `sample(i, size)`: s of samples. Each is in the middle of the `size` base steps from i on; `size` is a power
  of two that divides i.
- `place(ray, i, size)`: [3, ...] grid coordinates (cells) of these samples.
- `jump(ray, i, g, brick, reach)`: [n] the base step to look at next after step i. The middle of step i is at
  g [3, n], in the brick `brick` [3, n] of the finest level, and all bricks within `reach` [n] of that brick
  are empty. The middles of all steps in between are in no brick.
- `way(ray, i, size)`: the length of ray, in model units, that these samples stand for.
- `at(ray, s)`: [3, n] grid coordinates of any positions [n].
- `distances(ray, s)`: [n] t of these positions, model units.
- `pulled_back(gradients, ray, s)`: [3, n] gradients in the model frame, from gradients along the grid's axes,
  per model unit.
"""

from __future__ import annotations

import numpy as np

from player.asset.grid import SparseGrid
from player.march.box import Bounds, BoxPath, enter_box
from player.march.contracted import ContractedPath, enter_space

Path = BoxPath | ContractedPath


def path_of(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    bounds: Bounds | None = None,
) -> Path:
    """Make the path of rays through a grid of either kind; the arguments are those of `enter_box`. Bounds are
    ignored in contracted space, because there is no empty space around it."""
    if grid.contracted:
        return enter_space(grid, rays_o, rays_d)
    return enter_box(grid, rays_o, rays_d, bounds)
