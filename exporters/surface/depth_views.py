"""Depth pictures of an asset, rendered for the training cameras, and tests of which points the cameras see.

Letters: t, the distance from a camera to a point, world units; c, the cosine between the point's normal and
the direction to the camera. The camera sees the point if c > 0 and t is at most the depth that the picture
has there, plus a tolerance. Where the picture is less than half opaque, nothing hides the point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.views import asset_cameras
from player.progress import Progress, silent
from player.render import Renderer

MAX_VIEWS = 100
"""Largest number of views that are rendered unless fewer suffice; they are spread
over all training cameras."""
SMALL_PIXELS = 90_000
"""Largest number of pixels of a view that is rendered to find what is seen, and in which colour."""
FEW_PIXELS = 22_500
"""Largest number of pixels of such a view for a mesh of few faces, each as large as
several of these pixels."""
FULL_PIXELS = 1 << 18
"""Largest number of pixels of a view that is rendered for its depth, from which a surface is made."""
SOLID = 0.5
"""Least opacity of a pixel that has a depth."""
TOLERANCE = 2.0
"""Distance in voxels behind a pixel's depth up to which a point counts as seen,
because that depth is a mean."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """A training camera, and the depth and colours that it sees."""

    camera: Camera
    """World frame, at the size of the picture."""
    distance: np.ndarray
    """[height, width] float32, along the ray, world units; infinite where the opacity is below SOLID."""
    rgb: np.ndarray
    """[height, width, 3] uint8 sRGB, straight colours: not mixed with what is behind."""


def depth_views(
    asset: Asset, max_pixels: int = SMALL_PIXELS, max_views: int = MAX_VIEWS, progress: Progress = silent
) -> list[DepthView]:
    """Render the views of the training cameras, at most `max_views` of at most `max_pixels` each.

    Raises FormatError if the asset's cameras are damaged.
    """
    cameras = asset_cameras(asset)
    chosen = np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), max_views)).round().astype(int))
    views = []
    with Renderer(asset) as renderer:
        for index in chosen:
            camera = _small(cameras[index], max_pixels)
            frame = renderer.render(camera, background="transparent")
            distance = np.where(frame.opacity >= SOLID, frame.depth, np.float32(np.inf))
            views.append(DepthView(camera, distance.astype(np.float32), frame.to_uint8()[..., :3].copy()))
            progress(len(views), len(chosen))
    return views


def cosines_in_view(view: DepthView, points: np.ndarray, normals: np.ndarray, tolerance: float) -> np.ndarray:
    """Return how squarely a camera sees points: cosines [n] float32, 0 for points that it does not see.

    Args:
        view: the camera and its depth picture.
        points: [n, 3] world frame.
        normals: [n, 3] unit, world frame.
        tolerance: how far behind the depth of the pixels around it a point may be, world units.
    """
    result = np.zeros(len(points), np.float32)
    at = _projected(view.camera, points, normals)
    seen = at.distance <= _farthest_around(view.distance)[at.corners] + tolerance
    result[at.points[seen]] = at.cosines[seen]
    return result


class Sightings(NamedTuple):
    """Counts of the views that see each point, and of those that show something there."""

    seen: np.ndarray
    """[n] int32, the views in which nothing hides the point."""
    solid: np.ndarray
    """[n] int32, those of them whose picture is solid at the point's depth; the others see through it."""


def sightings(views: list[DepthView], points: np.ndarray, normals: np.ndarray, tolerance: float) -> Sightings:
    """Count the views that see each point; the arguments are those of `cosines_in_view`. A picture shows
    something at a point if the point is not more than `tolerance` nearer than the nearest, nor more than
    `tolerance` farther than the farthest, of the depths of the pixels around it."""
    seen, solid = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for view in views:
        at = _projected(view.camera, points, normals)
        farthest = _farthest_around(view.distance)[at.corners]
        nearest = -_farthest_around(-view.distance)[at.corners]
        in_sight = at.distance <= farthest + tolerance
        seen[at.points[in_sight]] += 1
        shown = in_sight & np.isfinite(farthest) & (at.distance >= nearest - tolerance)
        solid[at.points[shown]] += 1
    return Sightings(seen, solid)


class _Projected(NamedTuple):
    """The points that face a camera and are inside its picture."""

    points: np.ndarray
    """[m] int64, the numbers of these points."""
    distance: np.ndarray
    """[m] distance from the camera, world units."""
    cosines: np.ndarray
    """[m] cosine between the normal and the direction to the camera, above 0."""
    corners: tuple[np.ndarray, np.ndarray]
    """Row and column [m] of the corner between pixels that is nearest to where the point is seen."""


def _projected(camera: Camera, points: np.ndarray, normals: np.ndarray) -> _Projected:
    towards = camera.c2w[:3, 3] - points
    distance = np.sqrt(np.einsum("ij,ij->i", towards, towards))
    cosines = np.einsum("ij,ij->i", towards, normals) / np.maximum(distance, 1e-30)
    front = np.flatnonzero(cosines > 0)
    local = -towards[front] @ camera.c2w[:3, :3]
    depth = -local[:, 2]
    ahead = np.maximum(depth, 1e-30)
    column = camera.fx * local[:, 0] / ahead + camera.cx
    row = camera.cy - camera.fy * local[:, 1] / ahead
    inside = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    front, column, row = front[inside], column[inside], row[inside]
    corners = np.floor(row + 0.5).astype(int), np.floor(column + 0.5).astype(int)
    return _Projected(front, distance[front], cosines[front], corners)


def _farthest_around(distance: np.ndarray) -> np.ndarray:
    """Return distances [height + 1, width + 1] at the corners between pixels: the largest finite one
    of the up to four pixels around, so that no point inside a solid is seen past its outline;
    infinite if none is finite."""
    padded = np.pad(np.where(np.isfinite(distance), distance, -np.inf), 1, constant_values=-np.inf)
    farthest = np.maximum(
        np.maximum(padded[:-1, :-1], padded[1:, :-1]), np.maximum(padded[:-1, 1:], padded[1:, 1:])
    )
    return np.where(np.isfinite(farthest), farthest, np.float32(np.inf))


def _small(camera: Camera, max_pixels: int) -> Camera:
    """Return the camera at a size of at most `max_pixels` pixels."""
    share = (max_pixels / (camera.width * camera.height)) ** 0.5
    return camera if share >= 1 else camera.scaled(share)
