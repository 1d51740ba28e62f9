"""Make the asset's mesh: the surface of the written values, as `vfr-export` makes it, with few enough faces
to be a small part of the asset."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from exporters.formats.ply import small_ply_size
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.asset_surface import AssetSurface, Removed
from exporters.surface.depth_views import FEW_PIXELS
from exporters.surface.few_faces import few_faces
from exporters.surface.inner_region import inner_region
from player.asset.arranging import OTHERS
from player.asset.asset import Asset
from player.errors import ConfigError, DataError
from player.progress import Report

VIEWS = 50
"""Most views that are rendered for the mesh."""
LISTED_BYTES = 800
"""Bytes that the manifest may grow by once the mesh is made: it lists the reports, counts the faces, and says
what the pictures of the first parts lose."""


class BakedMesh(NamedTuple):
    """The mesh of an asset."""

    mesh: TriangleMesh
    """WORLD frame."""
    removed: Removed
    left_out: str | None
    """The surfaces that the mesh lacks, and why; None if it lacks none."""


def bake_mesh(asset: Asset, resolution: int, max_bytes: int, max_memory: float, report: Report) -> BakedMesh:
    """Make the mesh of an asset; it is empty if there is no surface, as in an even fog.

    In an unbounded scene it covers the inner region.

    Args:
        asset: complete but for its mesh; it is played.
        resolution: the mesh has at most as many faces as a grid of this many voxels along the box would give.
        max_bytes: the most bytes of the written mesh.
        max_memory: gigabytes that the densities may take on a single level.
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
        if small_ply_size(len(mesh.vertices), len(mesh.faces)) > max_bytes:
            raise DataError("mesh: expected fewer faces, got more than fit")  # Open3D is not installed
    except (ConfigError, DataError):  # no surface at the density level, no camera sees it, or it does not fit
        why = f"nowhere is the field dense enough for a surface, or none fits into {max_bytes:,} bytes"
        return BakedMesh(*empty, f"all of it: {why}")
    outside = "all surfaces outside the unit ball of the model frame" if asset.manifest.contracted else None
    return BakedMesh(surface.painted(mesh), removed, outside)


def mesh_bytes(others: int, max_mb: float | None) -> int:
    """Return the most bytes that the mesh may take beside `others` bytes of the asset's other files.

    Args:
        others: bytes of the asset's other files.
        max_mb: megabytes that the whole asset may take; None for no limit.

    >>> mesh_bytes(9_000_000, None), mesh_bytes(9_000_000, 9.5), mesh_bytes(9_000_000, 8.0)
    (1000000, 499200, 0)
    """
    left = np.inf if max_mb is None else max(int(max_mb * 1e6) - others - LISTED_BYTES, 0)
    return int(min(others // OTHERS, left))
