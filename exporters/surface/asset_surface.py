"""The surface of an asset in the world, made again from its density or its depth; what floats and what no
training camera sees is taken away.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from exporters.mesh.rays import MeshRays
from exporters.options import Method
from exporters.shapes.mesh import TriangleMesh, take_faces
from exporters.surface.components import remove_small_components
from exporters.surface.depth_views import (
    FULL_PIXELS,
    SMALL_PIXELS,
    TOLERANCE,
    DepthView,
    depth_views,
    seen_vertices,
)
from exporters.surface.fitted_colours import fit_colours
from exporters.surface.marching_cubes import extract_asset_surface, voxel_size
from exporters.surface.shaded_colours import surface_colours
from player.asset.asset import Asset
from player.errors import DataError, MissingExtraError

FLOATER_FRACTION = 1e-4
"""Connected parts with a smaller share of the faces are floaters and go."""

FIT_TOLERANCE = 3.0
"""Voxels between a pixel's depth and the mesh at which the pixel's colour still counts for it."""

Report = Callable[[str, int, int], object]
"""Called with (stage, done, of)."""


@dataclass(frozen=True)
class Removed:
    """What cleaning took away."""

    unseen: int
    """Faces that no training camera sees."""
    floaters: int
    """Parts that were too small."""
    floater_faces: int


class Scene:
    """An asset whose training cameras are played once, when somebody first asks what they see."""

    def __init__(self, asset: Asset, report: Report, max_pixels: int = SMALL_PIXELS) -> None:
        self.asset = asset
        self.report = report
        self.max_pixels = max_pixels
        """Of each view."""

    @cached_property
    def views(self) -> list[DepthView]:
        """What the training cameras see."""
        return depth_views(self.asset, self.max_pixels, lambda done, of: self.report("views", done, of))

    @property
    def voxel(self) -> float:
        """Edge of the asset's voxels, world units."""
        return voxel_size(self.asset.grid) * self.asset.scale

    def coloured(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`exporters.surface.shaded_colours.surface_colours` of this asset."""
        return surface_colours(
            self.asset, points, normals, self.views, lambda done, of: self.report("colours", done, of)
        )

    def surface(self, method: Method, level: float | None, stride: int = 1) -> tuple[TriangleMesh, Removed]:
        """The surface made again, white, and what was removed of it.

        Args:
            method: "density", marching cubes on the asset's density; "tsdf", depth pictures fused.
            level: density of the surface in 1/model unit, for "density".
            stride: of `exporters.surface.marching_cubes.extract_asset_surface`, for "density".

        Raises:
            ConfigError: a level outside the data.
            DataError: there is no surface, or nothing of it is seen.
            MissingExtraError: a package is not installed.
        """
        matrix = self.asset.world_from_model
        if method == "tsdf":
            from exporters.surface.tsdf import fuse_depth

            full = depth_views(self.asset, FULL_PIXELS, lambda done, of: self.report("views", done, of))
            vertices, faces, normals = fuse_depth(
                full, self.voxel, lambda done, of: self.report("fusion", done, of)
            )
        else:
            vertices, faces, normals = extract_asset_surface(
                self.asset.grid, level, lambda share: self.report("surface", round(share * 100), 100), stride
            )
            vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
            normals = normals @ matrix[:3, :3].T / self.asset.scale
        mesh = TriangleMesh(vertices, faces, normals, np.full((len(vertices), 4), 255, np.uint8))
        return cleaned(mesh, self.views, TOLERANCE * self.voxel)

    def painted(self, mesh: TriangleMesh) -> TriangleMesh:
        """A mesh on the surface with the colours that fit the training views best
        (`exporters.surface.fitted_colours`); where they see nothing, and where Open3D is not to be had, the
        head's own."""
        try:
            rgb, known = fit_colours(
                mesh,
                self.views,
                FIT_TOLERANCE * self.voxel,
                lambda done, of: self.report("colours", done, of),
            )
        except MissingExtraError:
            rgb, known = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices), bool)
        rest = np.flatnonzero(~known)
        rgb[rest], known[rest] = self.coloured(mesh.vertices[rest], mesh.normals[rest])
        colours = mesh.colours.copy()
        colours[:, :3] = np.rint(np.clip(rgb, 0, 1) * 255)
        if not known.all():  # beside the volume: what the corners around it are
            colours = _from_around(colours, known, mesh.faces)
        return replace(mesh, colours=colours)


def cleaned(mesh: TriangleMesh, views: list[DepthView], tolerance: float) -> tuple[TriangleMesh, Removed]:
    """A mesh (world frame) without the faces that no view sees and without floaters, and what went.

    A face is seen if a corner of it is: by a view that has nothing before it (`tolerance`: see
    `exporters.surface.depth_views.seen_vertices`), or because a pixel hits a face there. The second keeps
    what fills a hole, from whichever side it is seen; it needs Open3D, and where that is not to be had, it
    goes.

    Raises DataError: no face is seen.
    """
    seen = seen_vertices(views, mesh.vertices, mesh.normals, tolerance)
    with suppress(MissingExtraError):
        seen |= _hit_vertices(mesh, views)
    keep: np.ndarray = np.asarray(seen[mesh.faces].any(axis=1))
    if not keep.any():
        raise DataError(f"surface: expected some of {len(keep)} faces in a training camera's view, got none")
    part = mesh if keep.all() else take_faces(mesh, keep)
    whole, n_floaters = remove_small_components(part, FLOATER_FRACTION)
    return whole, Removed(int((~keep).sum()), n_floaters, len(part.faces) - len(whole.faces))


def _hit_vertices(mesh: TriangleMesh, views: list[DepthView]) -> np.ndarray:
    """[n_vertices] bool: corners of the faces that pixels of the views hit."""
    rays = MeshRays(mesh)
    hit = np.zeros(len(mesh.faces), bool)
    for view in views:
        hit[rays.seen_by(view.camera).faces] = True
    seen = np.zeros(len(mesh.vertices), bool)
    seen[mesh.faces[hit]] = True
    return seen


def _from_around(colours: np.ndarray, known: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Colours [n, 4], those not known taken from the known corners of their faces, then of theirs."""
    colours, known = colours.copy(), known.copy()
    while not known.all():
        open_ = faces[(~known)[faces].any(axis=1) & known[faces].any(axis=1)]
        if not len(open_):
            break
        weight = known[open_].sum(axis=1)
        mean = (colours[open_, :3] * known[open_][..., None]).sum(axis=1) / weight[:, None]
        total, count = np.zeros((len(colours), 3)), np.zeros(len(colours))
        for k in range(3):
            np.add.at(total, open_[:, k], mean)
            np.add.at(count, open_[:, k], 1)
        fresh = ~known & (count > 0)
        colours[fresh, :3] = np.rint(total[fresh] / count[fresh, None])
        known |= fresh
    return colours
