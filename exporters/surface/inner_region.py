"""The part of an asset that surfaces and volumes are made of, on one level: all of an object, and of an
unbounded scene what lies in the unit ball of the model frame.

In the unit ball contracted coordinates equal those of the model, so that the same vertices on the same grid
are a volume like an object's. What lies around it is contracted, and would be a ball of warped surroundings
in any other program.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from exporters.surface.one_level import one_level
from player.asset.asset import Asset, GridArrays
from player.asset.bricks import stored_bits
from player.asset.pyramid import Bricks, Pyramid, PyramidValues, live_cells, packed_bits
from player.errors import DataError
from player.files.memory import allowed_bytes


def inner_region(asset: Asset, max_memory: float | None = None) -> Asset:
    """Return the asset as exporters of surfaces and volumes take it: its densities on one level, and of an
    unbounded scene only those in the unit ball, on the grid of a box.

    Args:
        asset: an open asset.
        max_memory: gigabytes that the densities may take, as `Asset.open` has it.

    Raises:
        DataError: an unbounded scene has nothing in its unit ball.
        ConfigError: the densities take more memory than they may.
    """
    m, stored = asset.manifest, asset.arrays.densities
    if not m.contracted and len(stored.pyramid.levels) == 1:
        return asset
    densities = one_level(stored, allowed_bytes(max_memory), str(asset.folder))
    if m.contracted:
        densities = _inside(densities)
    if not len(densities.values[0]):
        raise DataError(
            f"{asset.folder}: expected an unbounded scene with something in its unit ball, got all "
            f"{stored.first_rows[-1]} vertices outside: surroundings without end are not exported"
        )
    one = {"level_steps": (1,), "density_steps": (1,), "parts": ()}
    manifest = replace(m, contracted=False, near=0.0, **one)
    return Asset(asset.folder, manifest, GridArrays(densities, asset.arrays.features))


def _inside(grid: PyramidValues) -> PyramidValues:
    """Return the cells of a grid of one level whose corners are all in the unit ball."""
    (cells,), (vertices,), (values,) = grid.pyramid.levels, grid.pyramid.vertices, grid.values
    # Cells along a model unit; the middle of the box is two model units from its corner along each axis.
    edge = grid.pyramid.resolution / 4
    inside = stored_bits(vertices.bricks.masks)
    inside[inside] = np.linalg.norm(vertices.index / edge - 2, axis=-1) <= 1
    whole = live_cells(Bricks(vertices.bricks.coords, packed_bits(inside)))
    kept = Bricks(cells.coords, cells.masks & whole.masks_at(cells.coords)).without_empty()
    pyramid = Pyramid(grid.pyramid.resolution, (kept,))
    return PyramidValues(pyramid, (values[vertices.rows_of(pyramid.vertices[0].bricks)],))
