"""The surface of an asset in the world, made again from its density or from depth pictures, without floaters
and without what no training camera sees."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from exporters.mesh.rays import MeshRays
from exporters.shapes.colour import KnownColours
from exporters.shapes.mesh import Surface, TriangleMesh, take_faces
from exporters.surface.components import remove_small_components
from exporters.surface.depth_views import (
    FULL_PIXELS,
    MAX_VIEWS,
    SMALL_PIXELS,
    TOLERANCE,
    DepthView,
    depth_views,
    sightings,
)
from exporters.surface.fitted_colours import fit_colours
from exporters.surface.marching_cubes import cut_surface, settled, voxel_size
from exporters.surface.shaded_colours import surface_colours
from exporters.surface.tsdf import fuse_depth
from player.asset.asset import Asset
from player.errors import DataError, MissingExtraError
from player.files.images import to_8_bit
from player.progress import Progress, Report

FLOATER_FRACTION = 1e-4
"""Connected parts with a smaller share of the faces than this are floaters, which are removed."""

FIT_TOLERANCE = 3.0
"""Largest distance in voxels between a pixel's depth and the mesh at which its colour counts for the mesh."""

SOLID_SHARE = 0.25
"""A vertex is haze if less than this share of the views that see it show something solid there. On good
models hardly any vertex is between 0 and a half (lego: 0.3 % of the faces)."""


class Removed(NamedTuple):
    """Counts of what was removed from a surface."""

    unseen_faces: int
    """Faces that no training camera sees."""
    haze_faces: int
    """Faces that training cameras see through: the pictures show something behind them, or nothing solid."""
    floaters: int
    """Connected parts that were too small."""
    floater_faces: int
    """Faces of the floaters."""


class AssetSurface:
    """Maker of meshes of an asset's surface, in the world. The views of the training cameras are rendered
    once, when they are first needed."""

    def __init__(
        self, asset: Asset, report: Report, max_pixels: int = SMALL_PIXELS, max_views: int = MAX_VIEWS
    ) -> None:
        self.asset = asset
        self.report = report
        self.max_pixels = max_pixels
        """Largest number of pixels of each view that is rendered."""
        self.max_views = max_views
        """Largest number of views that are rendered."""

    @cached_property
    def views(self) -> list[DepthView]:
        """The rendered views of the training cameras."""
        return self._played(self.max_pixels)

    @property
    def voxel(self) -> float:
        """Edge of the asset's voxels, world units."""
        return voxel_size(self.asset.grid) * self.asset.scale

    def from_density(self, level: float | None = None) -> tuple[TriangleMesh, Removed]:
        """Return the surface by marching cubes on the asset's density as a white mesh, and
        what was removed from it.

        Args:
            level: density of the surface, 1/model unit; `exporters.surface.marching_cubes` has the default.

        Raises:
            ConfigError: the level is outside the stored densities.
            DataError: there is no surface, or nothing of it is seen.
            MissingExtraError: scikit-image or scipy is not installed.
        """
        grid = self.asset.grid
        return self.cleaned(settled(grid, cut_surface(grid, level, self.on_cut)))

    def on_cut(self, share: float) -> None:
        """Report that this share of the grid has been cut."""
        self.report("surface", round(share * 100), 100)

    def from_depth(self) -> tuple[TriangleMesh, Removed]:
        """Return the surface that the depth pictures of the training cameras agree on as a white mesh, and
        what was removed from it.

        Raises:
            DataError: there is no surface, or nothing of it is seen.
            MissingExtraError: Open3D or scipy is not installed.
        """
        views = self._played(FULL_PIXELS)
        return self._in_world(fuse_depth(views, self.voxel, partial(self.report, "fusion")))

    def shaded(self, points: np.ndarray, normals: np.ndarray, progress: Progress) -> KnownColours:
        """Return the colours that the asset's head gives points [n, 3] on the surface with unit normals [n,
        3] (`exporters.surface.shaded_colours`); `progress` is called with (done, of)."""
        return surface_colours(self.asset, points, normals, self.views, progress)

    def painted(self, mesh: TriangleMesh) -> TriangleMesh:
        """Return a mesh on the surface with the colours that fit the training views best
        (`exporters.surface.fitted_colours`). Where the views see nothing, and everywhere if Open3D is not
        installed, the colours are the head's own."""
        progress = partial(self.report, "colours")
        try:
            tolerance = FIT_TOLERANCE * self.voxel
            rgb, known = fit_colours(mesh, self.views, tolerance, progress)
        except MissingExtraError:
            rgb, known = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices), bool)
        rest = np.flatnonzero(~known)
        rgb[rest], known[rest] = self.shaded(mesh.vertices[rest], mesh.normals[rest], progress)
        colours = mesh.colours.copy()
        colours[:, :3] = to_8_bit(rgb)
        return replace(mesh, colours=_from_around(colours, known, mesh.faces))

    def _played(self, max_pixels: int) -> list[DepthView]:
        return depth_views(self.asset, max_pixels, self.max_views, partial(self.report, "views"))

    def cleaned(self, surface: Surface) -> tuple[TriangleMesh, Removed]:
        """Return a surface (model frame) as a white mesh in the world, and what was removed from it."""
        matrix = self.asset.world_from_model
        vertices = surface.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        normals = surface.normals @ matrix[:3, :3].T / self.asset.scale
        return self._in_world(Surface(vertices, surface.faces, normals))

    def _in_world(self, surface: Surface) -> tuple[TriangleMesh, Removed]:
        white = np.full((len(surface.vertices), 4), 255, np.uint8)
        return cleaned(TriangleMesh(*surface, white), self.views, TOLERANCE * self.voxel)


def cleaned(mesh: TriangleMesh, views: list[DepthView], tolerance: float) -> tuple[TriangleMesh, Removed]:
    """Return a mesh (world frame) without the faces that no view sees, without haze and without floaters, and
    what was removed.

    A face is seen if a corner of it is seen: by a view in which nothing hides it (`tolerance`: see
    `exporters.surface.depth_views.sightings`), or because the ray of a pixel hits a face at that corner. The
    second test keeps faces that fill a hole, from whichever side they are seen. It needs Open3D; without it
    these faces are removed. A face that is seen is haze if no corner of it is solid for SOLID_SHARE of the
    views that see it, or, for a corner that only rays of pixels hit, if none of these pixels shows something
    at its depth or before.

    Raises DataError: no face is seen, or all that is seen is haze.
    """
    found = sightings(views, mesh.vertices, mesh.normals, tolerance)
    seen = found.seen > 0
    solid = seen & (found.solid >= SOLID_SHARE * found.seen)
    with suppress(MissingExtraError):
        hit, hit_solid = _hit_vertices(mesh, views, tolerance)
        solid |= hit_solid & ~seen
        seen |= hit
    is_seen, keep = (np.asarray(corners[mesh.faces].any(axis=1)) for corners in (seen, solid))
    if not keep.any():
        what = "haze that is seen through" if is_seen.any() else "none"
        raise DataError(
            f"surface: expected some of {len(keep)} faces in a training camera's view, got {what}"
        )
    part = mesh if keep.all() else take_faces(mesh, keep)
    whole, n_floaters = remove_small_components(part, FLOATER_FRACTION)
    n_unseen, n_gone = int((~is_seen).sum()), int((~keep).sum())
    return whole, Removed(n_unseen, n_gone - n_unseen, n_floaters, len(part.faces) - len(whole.faces))


def _hit_vertices(
    mesh: TriangleMesh, views: list[DepthView], tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the faces that rays of the views' pixels hit, [n_vertices] bool, and the corners
    of those that they hit no farther than `tolerance` before what the pixel shows."""
    rays = MeshRays(mesh)
    seen, solid = np.zeros((2, len(mesh.vertices)), bool)
    for view in views:
        hits = rays.seen_by(view.camera)
        seen[mesh.faces[hits.faces]] = True
        shown = hits.distance >= view.distance.reshape(-1)[hits.pixels] - tolerance
        solid[mesh.faces[hits.faces[shown]]] = True
    return seen, solid


def _from_around(colours: np.ndarray, known: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return colours [n, 4] in which vertices that are not `known` [n] take colours
    from known ones around them.

    The colours spread ring by ring: a face has the mean of its known corners, and an unknown corner takes the
    mean of its faces. A vertex that no faces connect with a known one keeps its colour. Alpha stays.
    """
    colours, known = colours.copy(), known.copy()
    while not known.all():
        open_ = faces[(~known)[faces].any(axis=1) & known[faces].any(axis=1)]
        if not len(open_):
            break
        weight = known[open_].sum(axis=1)
        mean = (colours[open_, :3] * known[open_][..., None]).sum(axis=1) / weight[:, None]
        total, count = np.zeros((len(colours), 3)), np.zeros(len(colours))
        np.add.at(total, open_.T, mean)
        np.add.at(count, open_.T, 1)
        fresh = ~known & (count > 0)
        colours[fresh, :3] = np.rint(total[fresh] / count[fresh, None])
        known |= fresh
    return colours
