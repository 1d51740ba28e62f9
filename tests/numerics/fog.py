"""Box filled with one density and one feature, 16 cells across, marched in steps of an eighth of a cell."""

from __future__ import annotations

import numpy as np

from player.asset.bricks import pack_vertices
from player.asset.grid import SparseGrid
from tests.vertex_grids import grid_of

RESOLUTION = 16
FEATURE = 100


def fog(optical: float, resolution: int = RESOLUTION, step: float = 2 / 128) -> SparseGrid:
    """Return a fog. `optical` is the optical depth of a step; 0 stands for the least that is allowed."""
    vertices = np.argwhere(np.ones((resolution + 1,) * 3))
    coords, masks, _ = pack_vertices(vertices)
    low = -80.0 if optical == 0 else float(np.clip(np.log(optical / step), -80, 79))
    codes = np.zeros(len(vertices), np.uint8)
    features = np.full((len(vertices), 1), FEATURE, np.int8)
    box = np.array([[-1.0] * 3, [1.0] * 3])
    where, both = (coords, masks), (resolution, resolution)
    return grid_of((*where, codes), (*where, features), both, box, step, (low, low + 1))
