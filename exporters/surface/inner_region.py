"""The part of an unbounded scene that has a shape: what lies in the unit ball of the model frame.

There contracted coordinates are those of the model, so that the same vertices on the same grid are a volume
like an object's. What is around it has been contracted, and would be a ball of warped surroundings in any
other program.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from player.asset.asset import Asset, GridArrays
from player.asset.bricks import pack_vertices, unpack_vertices
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
    densities = _inside(a.brick_coords, a.brick_masks, a.density, m.resolution, 0.0)
    # Cells of features reach over the ball's border, as the density's cells at it do.
    features = _inside(a.feature_coords, a.feature_masks, a.features, m.feature_resolution, REACH)
    if not len(densities[2]):
        raise DataError(
            f"{asset.folder}: expected an unbounded scene with something in its unit ball, got all "
            f"{len(a.density)} vertices outside: surroundings without end are not exported"
        )
    return Asset(asset.folder, replace(m, contracted=False, near=0.0), GridArrays(*densities, *features))


def _inside(
    coords: np.ndarray, masks: np.ndarray, codes: np.ndarray, resolution: int, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The bricks' coordinates, masks and codes of the vertices in the unit ball, or within `reach` cells of
    it."""
    index = unpack_vertices(coords, masks)
    edge = (
        resolution / 4
    )  # cells along a model unit; the middle of the ball is two model units from the corner
    inside = np.linalg.norm(index / edge - 2, axis=-1) <= 1 + reach / edge
    kept_coords, kept_masks, _ = pack_vertices(index[inside])  # the order stays: by brick, then by bit
    return kept_coords, kept_masks, np.asarray(codes)[inside]
