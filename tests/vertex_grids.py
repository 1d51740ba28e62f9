"""Grids of one level, made of vertices in bricks in the form that tests have at hand."""

from __future__ import annotations

import numpy as np

from player.asset.asset import GridArrays
from player.asset.grid import SparseGrid, VertexRows, build_grid, vertex_rows
from player.asset.single_level import VertexBricks, from_vertices

Three = tuple[np.ndarray, np.ndarray, np.ndarray]


def arrays_of(densities: Three, features: Three, resolutions: tuple[int, int]) -> GridArrays:
    """Return the arrays of both grids, each given as the coordinates and masks of bricks of vertices and the
    codes; `resolutions` are the cells per axis of each."""
    both = zip((densities, features), resolutions, strict=True)
    return GridArrays(*(from_vertices(VertexBricks(*stored), resolution) for stored, resolution in both))


def grid_of(
    densities: Three,
    features: Three,
    resolutions: tuple[int, int],
    aabb: np.ndarray,
    step: float,
    density_range: tuple[float, float],
    contracted: bool = False,
) -> SparseGrid:
    """Return the grid of `arrays_of`; the other arguments are those of `build_grid`."""
    arrays = arrays_of(densities, features, resolutions)
    return build_grid(arrays.densities, arrays.features, aabb, step, (1,), density_range, contracted)


def rows_of(coords: np.ndarray, masks: np.ndarray, resolution: int) -> VertexRows:
    """Return the rows of the vertices in bricks."""
    n = int(np.bitwise_count(masks).sum())
    values = np.zeros((n, 1), np.int8)
    return vertex_rows(from_vertices(VertexBricks(coords, masks, values), resolution).pyramid)
