"""Ray casting with Open3D (Embree): the face of a mesh that each pixel of a camera sees.

Letters: t, the distance along a ray of unit direction; b, the weights of a face's three corners at the point
that a ray hits (barycentric coordinates), of sum 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from exporters.extras import require_open3d
from exporters.shapes.mesh import TriangleMesh
from player.cameras.camera import Camera


class Hits(NamedTuple):
    """The points where rays through the pixels of a camera hit a mesh."""

    pixels: np.ndarray
    """[n] int64, the pixels whose ray hits the mesh, ascending; pixels are numbered row by row."""
    distance: np.ndarray
    """[n] float32, distance t along the ray, world units."""
    faces: np.ndarray
    """[n] int64, the first face that the ray hits."""
    shares: np.ndarray
    """[n, 3] float64, the weights b of that face's corners."""


class MeshRays:
    """A mesh prepared for ray casting.

    Embree computes in float32. The mesh and the cameras are therefore moved together until the middle of the
    mesh is the origin, which keeps the digits of a world far from its origin.

    Raises MissingExtraError: Open3D is not installed.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        open3d = require_open3d("the mesh")
        self._tensor = open3d.core.Tensor
        self._moved_from_world = np.eye(4)
        self._moved_from_world[:3, 3] = -mesh.bounds.mean(axis=0)
        vertices = mesh.vertices + self._moved_from_world[:3, 3]
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(mesh.faces, np.uint32)
        )

    def seen_by(self, camera: Camera) -> Hits:
        """Return where the rays through the pixel centres of a camera (world frame) hit the mesh."""
        rays = np.concatenate(camera.transformed(self._moved_from_world).rays(), axis=1)
        answer = self._scene.cast_rays(self._tensor(np.ascontiguousarray(rays, np.float32)))
        distance = answer["t_hit"].numpy()
        pixels = np.flatnonzero(np.isfinite(distance))
        u, v = answer["primitive_uvs"].numpy()[pixels].T.astype(np.float64)
        faces = answer["primitive_ids"].numpy()[pixels].astype(np.int64)
        return Hits(pixels, distance[pixels], faces, np.stack([1 - u - v, u, v], axis=-1))
