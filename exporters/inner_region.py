"""The part of an unbounded scene that has a shape: what lies in the unit ball of the model frame.

There contracted coordinates are those of the model, so that the same vertices on the same grid are a volume
like an object's. What is around it has been contracted, and would be a ball of warped surroundings in any
other program.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from player.asset import Asset, GridArrays
from player.bricks import pack_vertices, unpack_vertices
from player.errors import DataError


def inner_region(asset: Asset) -> Asset:
    """The asset as exporters of surfaces and volumes take it: itself, or of an unbounded scene its inner
    region, whose grid is a box's.

    Raises DataError: an unbounded scene that has nothing there.
    """
    m, a = asset.manifest, asset.arrays
    if not m.contracted:
        return asset
    index = unpack_vertices(a.brick_coords, a.brick_masks)
    edge = m.resolution / 4  # cells of a model unit; the middle is at two of them
    inside = np.linalg.norm(index / edge - 2, axis=-1) <= 1
    if not inside.any():
        raise DataError(
            f"{asset.folder}: expected an unbounded scene with something in its unit ball, got all "
            f"{len(index)} vertices outside: surroundings without end are not exported"
        )
    coords, masks, _ = pack_vertices(index[inside])  # the order stays: by brick, then by bit
    arrays = GridArrays(coords, masks, np.asarray(a.density)[inside], np.asarray(a.features)[inside])
    return Asset(asset.folder, replace(m, contracted=False), arrays)
