"""Grids of one level out of vertices in bricks, as tests have them at hand."""

from __future__ import annotations

import numpy as np

from player.asset.asset import GridArrays
from player.asset.grid import SparseGrid, VertexRows, build_grid, vertex_rows
from player.asset.single_level import VertexBricks, from_vertices

Three = tuple[np.ndarray, np.ndarray, np.ndarray]


def arrays_of(densities: Three, features: Three, resolutions: tuple[int, int]) -> GridArrays:
    """Both are coordinates and masks of bricks of vertices, and codes; cells per axis of each."""
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
    """The grid of `arrays_of`; the other arguments are those of `build_grid`."""
    arrays = arrays_of(densities, features, resolutions)
    return build_grid(arrays.densities, arrays.features, aabb, step, (1,), density_range, contracted)


def rows_of(coords: np.ndarray, masks: np.ndarray, resolution: int) -> VertexRows:
    """The rows of the vertices of bricks."""
    n = int(np.bitwise_count(masks).sum())
    values = np.zeros((n, 1), np.int8)
    return vertex_rows(from_vertices(VertexBricks(coords, masks, values), resolution).pyramid)
