"""The asset's mesh: the surface of what was written, as `vfr-export` makes it, in so few faces that it is a
small part of the asset."""

from __future__ import annotations

import numpy as np

from exporters.progress import Report
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.asset_surface import AssetSurface, Removed
from exporters.surface.depth_views import FEW_PIXELS
from exporters.surface.few_faces import few_faces
from exporters.surface.inner_region import inner_region
from player.asset.asset import Asset
from player.errors import ConfigError, DataError

VIEWS = 50
"""Most views that are played for the mesh."""
OTHERS = 9
"""Bytes of the other files for a byte of the mesh: it is at most a tenth of the asset."""
FEWEST_BYTES = 43_000
"""A mesh of about 2,000 faces, which every asset may have."""


def bake_mesh(asset: Asset, resolution: int, max_bytes: int, report: Report) -> tuple[TriangleMesh, Removed]:
    """The mesh in the WORLD frame, and what was removed of it.

    In an unbounded scene it covers the inner region; an even fog, which has no surface, has an empty mesh.

    Args:
        asset: complete but for its mesh; it is played.
        resolution: the mesh has at most the faces that a grid of so many voxels along the box would give it.
        max_bytes: the most bytes of the mesh as it is written.
        report: called with (stage, done, of).
    """
    try:
        surface = AssetSurface(inner_region(asset), report, FEW_PIXELS, VIEWS)
        mesh, removed = few_faces(surface, resolution, max_bytes)
    except (ConfigError, DataError):  # nowhere as dense as a level, everywhere, or seen by nobody
        none = np.zeros((0, 3))
        empty = TriangleMesh(none, none.astype(np.int32), none, np.zeros((0, 4), np.uint8))
        return empty, Removed(0, 0, 0, 0)
    return surface.painted(mesh), removed


def mesh_bytes(others: int, max_mb: float | None) -> int:
    """The most bytes that the mesh may take beside `others` bytes of the asset's other files.

    Args:
        max_mb: megabytes that the whole asset may take; None is any number.

    >>> mesh_bytes(9_000_000, None), mesh_bytes(9_000_000, 9.5), mesh_bytes(9_000_000, 8.0)
    (1000000, 500000, 43000)
    """
    most = others // OTHERS
    if max_mb is not None:
        most = min(most, int(max_mb * 1e6) - others)
    return max(most, FEWEST_BYTES)
