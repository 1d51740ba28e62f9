"""The path of rays through a grid: the one difference between an object's box and contracted space.

A path holds n rays. On each lies a lattice of base steps that depends on the ray alone, so that skipping what
is empty never changes a picture; a place on a ray is a number s >= 0 that rises along it. A path has `first`
[n], the first base step of each ray to look at, `length` [n], the s at which each ray ends, and these
methods, where `ray` are numbers of rays, `i` numbers of base steps and `s` places, of shapes that broadcast:

- `sample(i, size)`: s of samples: the middles of `size` base steps, a power of two that divides i, from i on.
- `place(ray, i, size)`: [3, ...] grid coordinates (cells) of these.
- `jump(ray, i, g, brick, reach)`: [n] the base step to look at next, after step i, whose middle is at g
  [3, n] in the brick `brick` [3, n] of the finest level, where all bricks within `reach` [n] of that are
  empty. The middles of all steps between them are in no brick.
- `way(ray, i, size)`: the model units that these samples stand for.
- `at(ray, s)`: [3, n] grid coordinates of any places [n].
- `distances(ray, s)`: [n] t of these, model units.
- `pulled_back(gradients, ray, s)`: [3, n] gradients along the grid's axes, per model unit, as gradients in
  the model frame.
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
    """The path of rays through a grid of either kind; the arguments are those of `enter_box`. In contracted
    space, around which nothing is empty, bounds are ignored."""
    if grid.contracted:
        return enter_space(grid, rays_o, rays_d)
    return enter_box(grid, rays_o, rays_d, bounds)
