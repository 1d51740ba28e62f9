"""An alternative surface: depth pictures of the training cameras, fused by Open3D
(Curless and Levoy 1996).

Marching cubes uses the density at a place; fusion uses how far the cameras see. Fog in front of a surface
then counts for less, and thin parts that few pixels hit are lost. Pixels of less than half opacity are left
out. So are pixels beside a jump in depth, because their mean depth lies between two surfaces.

Open3D computes places in float32. The cameras are therefore moved until the mean of their places is the
origin, which keeps the digits of a world far from its origin.
"""

from __future__ import annotations

import numpy as np

from exporters.extras import require_open3d
from exporters.shapes.mesh import Surface, has_three_corners, unit_normals
from exporters.surface.depth_views import DepthView
from player.cameras.rotations import OPENGL_FROM_OPENCV
from player.errors import DataError
from player.progress import Progress, silent

TRUNCATION = 3.0
"""Truncation distance in voxels: a depth takes effect up to so far before and behind it."""
JUMP = 5.0
"""Largest difference in voxels between the depths of neighbouring pixels that see one surface; a surface seen
at 80 degrees stays below it."""
_BLOCKS = 50_000  # blocks of 8^3 voxels that are allocated at first; Open3D adds more when it needs them
_LEAST_WEIGHT = 1.0  # least number of views that have seen a voxel


def fuse_depth(views: list[DepthView], voxel: float, progress: Progress = silent) -> Surface:
    """Fuse depth pictures into the surface that they agree on.

    Args:
        views: cameras and depth pictures, world frame.
        voxel: edge of the voxels, world units.
        progress: called with (done, of) after each view.

    Returns:
        The surface in the world frame; its outside is where the cameras are.

    Raises:
        DataError: no view sees anything.
        MissingExtraError: Open3D is not installed.
    """
    open3d = require_open3d("--method tsdf")
    core, tensor = open3d.core, open3d.core.Tensor
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), (1, 1), voxel, 8, _BLOCKS, core.Device("CPU:0")
    )
    # Moved by whole voxels, so that the lattice, and with it the surface, does not depend on the cameras.
    middle = np.round(np.mean([view.camera.c2w[:3, 3] for view in views], axis=0) / voxel) * voxel
    for done, view in enumerate(views, start=1):
        camera = view.camera
        depth = reliable_depth(view, JUMP * voxel)
        if depth.any():
            # Open3D counts pixel centres at whole numbers, and its cameras look along +z with y down.
            lens = np.array(
                [[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]], np.float64
            )
            c2w = camera.c2w.copy()
            c2w[:3, 3] -= middle
            pose = np.linalg.inv(c2w @ OPENGL_FROM_OPENCV)
            picture = open3d.t.geometry.Image(tensor(depth))
            where = (tensor(lens), tensor(pose), 1.0, float(depth.max()) + voxel, TRUNCATION)
            grid.integrate(grid.compute_unique_block_coordinates(picture, *where), picture, *where)
        progress(done, len(views))
    try:
        mesh = grid.extract_triangle_mesh(weight_threshold=_LEAST_WEIGHT).to_legacy()
    except RuntimeError:  # a grid without a block
        mesh = open3d.geometry.TriangleMesh()
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int32)
    if not len(faces):
        raise DataError("--method tsdf: expected a surface in the training cameras' views, got none")
    places, faces, normals = _in_order(vertices, faces)
    return Surface(places + middle, faces, normals)


def reliable_depth(view: DepthView, jump: float) -> np.ndarray:
    """Return the depth along the camera's axis, [height, width] float32. It is 0 where it is not reliable:
    nothing is hit, or a neighbouring pixel is farther or nearer by more than `jump` (world units)."""
    camera = view.camera
    columns, rows = np.meshgrid(
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,
    )
    hit = np.isfinite(view.distance)
    z = np.where(hit, view.distance / np.sqrt(1 + columns**2 + rows**2), np.nan)
    padded = np.pad(z, 1, mode="edge")
    good = hit.copy()
    for row, column in ((0, 1), (2, 1), (1, 0), (1, 2)):
        beside = padded[row : row + z.shape[0], column : column + z.shape[1]]
        good &= ~(np.abs(beside - z) > jump)  # NaN, where nothing is hit, is no jump
    return np.where(good, z, 0).astype(np.float32)


def _in_order(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """Return the surface with its vertices sorted by place and its faces by number, whatever order they came
    in. Its normals are the mean normals of the faces around, weighted by area."""
    places, number = np.unique(vertices, axis=0, return_inverse=True)
    corners = number.reshape(-1)[faces]
    corners = corners[has_three_corners(corners)]
    order = (np.argmin(corners, axis=1)[:, None] + np.arange(3)) % 3  # a face's smallest number comes first
    triangles = np.unique(np.take_along_axis(corners, order, axis=1), axis=0)
    normals = unit_normals(np.zeros_like(places), places, triangles)
    return Surface(places, triangles.astype(np.int32), normals)
