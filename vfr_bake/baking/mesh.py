"""The asset's mesh: the surface of what was written, as `vfr-export` makes it, in so few faces that it is a
small part of the asset."""

from __future__ import annotations

from typing import NamedTuple

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


class BakedMesh(NamedTuple):
    """The mesh of an asset."""

    mesh: TriangleMesh
    """WORLD frame."""
    removed: Removed
    left_out: str | None
    """What is not in it, and why."""


def bake_mesh(asset: Asset, resolution: int, max_bytes: int, max_memory: float, report: Report) -> BakedMesh:
    """The mesh of an asset; an empty one where there is no surface, as in an even fog.

    In an unbounded scene it covers the inner region.

    Args:
        asset: complete but for its mesh; it is played.
        resolution: the mesh has at most the faces that a grid of so many voxels along the box would give it.
        max_bytes: the most bytes of the mesh as it is written.
        max_memory: gigabytes that the densities may take on one level.
        report: called with (stage, done, of).
    """
    none = np.zeros((0, 3))
    empty = TriangleMesh(none, none.astype(np.int32), none, np.zeros((0, 4), np.uint8)), Removed(0, 0, 0, 0)
    try:
        inner = inner_region(asset, max_memory)
    except ConfigError:
        why = f"on one level the densities take more than {max_memory:g} GB of memory"
        return BakedMesh(*empty, f"all of it: {why}: vfr-export --max-memory makes it of the asset")
    except DataError:
        return BakedMesh(*empty, "all of it: there is nothing in the unit ball of the model frame")
    try:
        surface = AssetSurface(inner, report, FEW_PIXELS, VIEWS)
        mesh, removed = few_faces(surface, resolution, max_bytes)
    except (ConfigError, DataError):  # nowhere as dense as a level, everywhere, or seen by nobody
        return BakedMesh(*empty, "all of it: nowhere is the field dense enough for a surface")
    outside = "all surfaces outside the unit ball of the model frame" if asset.manifest.contracted else None
    return BakedMesh(surface.painted(mesh), removed, outside)


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
