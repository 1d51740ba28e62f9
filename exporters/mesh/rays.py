"""Which face of a mesh each pixel of a camera sees: rays cast by Open3D (Embree).

Letters: t, the distance along a ray of unit direction; b, what each of a face's three corners counts at the
place that a ray meets, of sum 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from exporters.extras import require_open3d
from exporters.shapes.mesh import TriangleMesh
from player.cameras.camera import Camera


class Hits(NamedTuple):
    """The places where rays through the pixels of a camera meet a mesh."""

    pixels: np.ndarray
    """[n] int64, the pixels whose ray meets the mesh, ascending; pixels are numbered row by row."""
    distance: np.ndarray
    """[n] float32, distance along the ray, world units."""
    faces: np.ndarray
    """[n] int64, the first face that the ray meets."""
    shares: np.ndarray
    """[n, 3] float64, the shares b of that face's corners."""


class MeshRays:
    """A mesh, ready to be looked at.

    Raises MissingExtraError: Open3D is not installed.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        open3d = require_open3d("the mesh")
        self._tensor = open3d.core.Tensor
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            np.ascontiguousarray(mesh.vertices, np.float32), np.ascontiguousarray(mesh.faces, np.uint32)
        )

    def seen_by(self, camera: Camera) -> Hits:
        """Where the rays through the pixel centres of a camera (world frame) meet the mesh."""
        rays = np.concatenate(camera.rays(), axis=1)
        answer = self._scene.cast_rays(self._tensor(np.ascontiguousarray(rays, np.float32)))
        distance = answer["t_hit"].numpy()
        pixels = np.flatnonzero(np.isfinite(distance))
        u, v = answer["primitive_uvs"].numpy()[pixels].T.astype(np.float64)
        faces = answer["primitive_ids"].numpy()[pixels].astype(np.int64)
        return Hits(pixels, distance[pixels], faces, np.stack([1 - u - v, u, v], axis=-1))
