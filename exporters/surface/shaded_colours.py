"""Colours of a surface, computed by the asset's head for short rays onto it.

A ray starts a few voxels above the point and is marched as in the player, so that a point that lies slightly
off the surface still gets the surface's colour. A point has one colour for all directions: the mean over the
directions of training cameras that see the point, or, if none does, the colour seen along the normal.
docs/notes/2026-11-21-surfaces.md has the measurement that led to this choice.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from exporters.shapes.colour import KnownColours
from exporters.shapes.mesh import unit
from exporters.surface.depth_views import TOLERANCE, DepthView, cosines_in_view
from exporters.surface.marching_cubes import voxel_size
from player.asset.asset import Asset
from player.head.head import Head
from player.progress import Progress, silent
from player.render import choose_march
from player.threads import default_threads

STAND_OFF = 3.0
"""Distance above the surface at which a ray starts, voxels."""
MAX_DIRECTIONS = 4
"""Largest number of cameras that count for a point: eight are no nearer to the player's pictures
(docs/notes/2026-11-21-surfaces.md)."""
_RAYS = 1 << 14  # rays that a thread marches at a time
_LEAST = 0.1  # least opacity of a ray that has a colour


def surface_colours(
    asset: Asset,
    points: np.ndarray,
    normals: np.ndarray,
    views: list[DepthView],
    progress: Progress = silent,
) -> KnownColours:
    """Return colours of points on a surface.

    Args:
        asset: the asset whose grid and head give the colours.
        points: [n, 3] world frame, within a few voxels of the surface.
        normals: [n, 3] unit, world frame, outwards.
        views: the training cameras that may be averaged over; an empty list for views along the normal alone.
        progress: called with (done, of) after each view and at the end.

    Returns:
        rgb [n, 3] float32; a point is known if a ray hit something there.
    """
    with ThreadPoolExecutor(default_threads(), thread_name_prefix="vfr-export") as pool:
        shade = _Shader(asset, pool)
        total = np.zeros((len(points), 3), np.float32)
        weight = np.zeros(len(points), np.float32)
        n_used = np.zeros(len(points), np.int32)
        tolerance = TOLERANCE * voxel_size(asset.grid) * asset.scale
        for done, index in enumerate(_spread(len(views)), start=1):
            open_ = np.flatnonzero(n_used < MAX_DIRECTIONS)
            cosines = cosines_in_view(views[index], points[open_], normals[open_], tolerance)
            rows = open_[cosines > 0]
            rays = points[rows] - views[index].camera.c2w[:3, 3]
            rgb, opacity = shade(points[rows], unit(rays, 0.0))
            counted = np.where(opacity > _LEAST, cosines[cosines > 0], 0).astype(np.float32)
            total[rows] += rgb * counted[:, None]
            weight[rows] += counted
            n_used[rows] += counted > 0
            progress(done, len(views) + 1)
        rest = np.flatnonzero(n_used == 0)
        rgb, opacity = shade(points[rest], -normals[rest])
        total[rest], weight[rest] = rgb, opacity > _LEAST
        progress(len(views) + 1, len(views) + 1)
    known = weight > 0
    return KnownColours(np.where(known[:, None], total / np.where(known, weight, 1)[:, None], 0), known)


class _Shader:
    """Callable that computes the colours of rays in tasks of a thread pool."""

    def __init__(self, asset: Asset, pool: ThreadPoolExecutor) -> None:
        self._asset = asset
        self._grid = replace(asset.grid, contracted=False)  # space is not contracted where surfaces are made
        self._march = choose_march("auto")[1].march
        self._head = Head.of(asset)
        self._model_from_world = np.linalg.inv(asset.world_from_model)
        self._pool = pool

    def __call__(self, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rgb [n, 3] and opacity [n], float32, seen along `dirs` [n, 3] (world) at `points` [n, 3]."""
        parts = [slice(start, start + _RAYS) for start in range(0, len(points), _RAYS)]
        found = list(self._pool.map(lambda part: self._task(points[part], dirs[part]), parts))
        if not found:
            return np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        rgb, opacity = zip(*found, strict=True)
        return np.concatenate(rgb), np.concatenate(opacity)

    def _task(self, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        matrix = self._model_from_world
        rays_d = (dirs @ matrix[:3, :3].T * self._asset.scale).astype(np.float32)
        reach = np.float32(STAND_OFF * voxel_size(self._asset.grid))
        rays_o = (points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32) - reach * rays_d
        bounds = np.zeros(len(points), np.float32), np.full(len(points), 3 * reach, np.float32)
        result = self._march(self._grid, rays_o, rays_d, self._asset.manifest.n_fetches, bounds)
        rgb = np.zeros((len(points), 3), np.float32)
        opacity = result.opacity[result.hits]
        rgb[result.hits] = self._head(result.features / opacity[:, None], rays_d[result.hits])
        return rgb, result.opacity


def _spread(n: int) -> list[int]:
    """Return 0..n - 1 in an order of which every beginning is spread evenly, by steps of the golden section.

    >>> _spread(5)
    [0, 2, 4, 1, 3]
    """
    return sorted(range(n), key=lambda index: (index * 0.6180339887498949) % 1)
