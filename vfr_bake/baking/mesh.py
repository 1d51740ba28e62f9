"""The asset's mesh: the surface of what was written, as `vfr-export --method density` makes it, in fewer
faces."""

from __future__ import annotations

import numpy as np

from exporters.mesh.simplify import simplify_mesh
from exporters.progress import Report
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.asset_surface import AssetSurface, Removed
from exporters.surface.inner_region import inner_region
from exporters.surface.marching_cubes import extract_asset_surface
from player.asset.asset import Asset
from player.asset.grid import SparseGrid
from player.errors import ConfigError, DataError, MissingExtraError

PIXELS = 22_500
"""Most pixels of a view that is played for the mesh, whose faces are as large as several of these pixels."""
BYTES_A_FACE = 27
"""Bytes that a face takes in a PLY file: 13 for the face itself, and half a vertex of 28 bytes."""


def bake_mesh(asset: Asset, resolution: int, report: Report) -> tuple[TriangleMesh, Removed]:
    """The mesh in the WORLD frame, and what was removed of it.

    In an unbounded scene it covers the inner region; an even fog, which has no surface, has an empty mesh.

    Args:
        asset: complete but for its mesh; it is played.
        resolution: the mesh has as many faces as a grid of so many voxels along the box would give it, or
            all where Open3D, which takes faces away, is not to be had.
        report: called with (stage, done, of).
    """
    try:
        surface = AssetSurface(inner_region(asset), report, PIXELS)
        mesh, removed = surface.from_density(stride=_stride(asset.grid, resolution))
    except (ConfigError, DataError):  # nowhere as dense as a level, everywhere, or seen by nobody
        none = np.zeros((0, 3))
        return TriangleMesh(none, none.astype(np.int32), none, np.zeros((0, 4), np.uint8)), Removed(0, 0, 0)
    n_faces = max(round(len(mesh.faces) * _share(asset.grid, resolution)), 1)
    try:
        mesh = simplify_mesh(mesh, n_faces)
    except MissingExtraError:
        report("fewer faces", 1, 1)
    return surface.painted(mesh), removed


def mesh_size(grid: SparseGrid, resolution: int) -> int:
    """Most bytes that the mesh will take, for a budget that is shared out before there is a mesh."""
    try:
        _, faces, _ = extract_asset_surface(grid, stride=_stride(grid, resolution))
    except (ConfigError, DataError):
        return 0
    return round(len(faces) * _share(grid, resolution) * BYTES_A_FACE)


def _stride(grid: SparseGrid, resolution: int) -> int:
    """2 where every second vertex of the grid still makes a mesh that is twice as fine along an axis as is
    wanted, otherwise 1."""
    return 2 if grid.resolution >= 4 * resolution else 1


def _share(grid: SparseGrid, resolution: int) -> float:
    """Share of the extracted faces that is wanted."""
    return min(resolution * _stride(grid, resolution) / grid.resolution, 1.0) ** 2
