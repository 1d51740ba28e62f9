"""The part of an unbounded scene that has a shape: what lies in the unit ball of the model frame.

There contracted coordinates are those of the model, so that the same vertices on the same grid are a volume
like an object's. What is around it has been contracted, and would be a ball of warped surroundings in any
other program.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from player.asset.asset import Asset, GridArrays
from player.asset.bricks import pack_vertices
from player.asset.pyramid import PyramidValues
from player.asset.single_level import VertexBricks, from_vertices
from player.errors import DataError

REACH = 2.0
"""How many cells around the ball keep their features; the diagonal of a cell is shorter."""


def inner_region(asset: Asset) -> Asset:
    """The asset as exporters of surfaces and volumes take it: itself, or of an unbounded scene its inner
    region, whose grid is a box's.

    Raises DataError: an unbounded scene that has nothing there.
    """
    m, a = asset.manifest, asset.arrays
    if not m.contracted:
        return asset
    densities = _inside(a.densities, 0.0)
    # Cells of features reach over the ball's border, as the density's cells at it do.
    features = _inside(a.features, REACH)
    if not len(densities.values[0]):
        raise DataError(
            f"{asset.folder}: expected an unbounded scene with something in its unit ball, got all "
            f"{len(a.densities.values[0])} vertices outside: surroundings without end are not exported"
        )
    return Asset(asset.folder, replace(m, contracted=False, near=0.0), GridArrays(densities, features))


def _inside(grid: PyramidValues, reach: float) -> PyramidValues:
    """What is stored in the unit ball, or within `reach` cells of it."""
    resolution = grid.pyramid.resolution
    index = grid.pyramid.vertices[0].index
    edge = resolution / 4  # cells along a model unit; the middle is two model units from the corner
    inside = np.linalg.norm(index / edge - 2, axis=-1) <= 1 + reach / edge
    coords, masks, _ = pack_vertices(index[inside])  # the order stays: by brick, then by bit
    return from_vertices(VertexBricks(coords, masks, grid.values[0][inside]), resolution)
