"""A triangle mesh from a density field: marching cubes, and the removal of what floats.

Letters: sigma, density in 1/scene unit; v, voxel size; alpha = 1 - exp(-sigma v), the opacity of one voxel.
The default level is the density where alpha is one half, sigma = ln 2 / v: a number that follows from the
grid and not from the scene.

Cubes are cut on log(sigma), clipped to a factor of 50 on both sides of the level. Densities are exponentials,
so that their logarithm is nearly linear between two samples; the clip keeps an empty or culled neighbour from
pulling the surface. On fifteen test fields (edges from a tenth of a voxel to two voxels wide) it puts
vertices within 0.003 to 0.2 voxel of the truth, nearer than opacity (0.004 to 0.2) nearly everywhere and by
up to ten times on dense fields.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from exporters.shapes.mesh import TriangleMesh, take_faces
from player.errors import ConfigError, DataError, MissingExtraError, ShapeError

Density = Callable[[np.ndarray], np.ndarray]
"""[n, 3] float32 points -> [n] float32 density in 1/scene unit."""

_CLIP = 50.0
_SLAB = 1 << 19  # points asked of the field at once: 6 MB of coordinates


def extract_surface(
    sample_density: Density,
    aabb: np.ndarray,
    resolution: int,
    level: float | None = None,
    progress: Callable[[float], object] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface where the density equals `level`, inside a box; where it leaves the box the mesh is open.

    Memory: 4 bytes a grid point, the cubes' triangles, and one slab of points.

    Args:
        sample_density: the field, asked for at most half a million points at once.
        aabb: [2, 3] smallest and largest corner, scene units.
        resolution: voxels along the longest side, 2 or more; voxels are cubes to within rounding.
        level: density of the surface in 1/scene unit; None is ln 2 / voxel size.
        progress: called with the share done in (0, 1] after each slab.

    Returns:
        vertices [n_vertices, 3] float64 in the frame of `aabb`; faces [n_faces, 3] int32, counter-clockwise
        seen from the side of lower density, none of area 0; normals [n_vertices, 3] float64, unit, towards
        lower density.

    Raises:
        ShapeError, ConfigError: a wrong argument; a level outside the data, with the valid range.
        DataError: there is no density in the box, or the field answers NaN, a negative number or another
            shape.
        MissingExtraError: scikit-image is not installed.
    """
    aabb = np.asarray(aabb, np.float64)
    if aabb.shape != (2, 3):
        raise ShapeError(f"surface: aabb: expected [2, 3], got {aabb.shape}")
    if not (np.isfinite(aabb).all() and (aabb[1] > aabb[0]).all()):
        raise ConfigError(f"surface: aabb: expected finite corners, smallest first, got {aabb.tolist()}")
    if resolution < 2:
        raise ConfigError(f"surface: resolution: expected 2 or more voxels, got {resolution}")
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise MissingExtraError("the mesh: needs scikit-image: pip install vfr-bake[export]") from error
    extent = aabb[1] - aabb[0]
    voxel = float(extent.max()) / resolution
    if level is None:
        level = math.log(2) / voxel
    if not (math.isfinite(level) and level > 0):
        raise ConfigError(f"surface: level: expected a density > 0, got {level}")
    shape = np.maximum(np.rint(extent / voxel).astype(int), 1) + 1
    axes = [np.linspace(aabb[0, k], aabb[1, k], shape[k]) for k in range(3)]
    volume, lowest, highest = _sample_grid(sample_density, axes, level, progress)
    if highest <= 0:
        raise DataError(f"surface: density: expected some in the box {aabb.tolist()}, got none")
    if not lowest < level < highest:
        raise ConfigError(
            f"surface: level: expected a density between {lowest:g} and {highest:g}, the range in the "
            f"box at resolution {resolution}, got {level:g}"
        )
    # "ascent" is the winding that is counter-clockwise from the side of lower values: a test holds the sign
    # of a volume.
    corners, faces, _, _ = marching_cubes(volume, 0.0, gradient_direction="ascent", allow_degenerate=False)
    vertices = aabb[0] + corners.astype(np.float64) * (extent / (shape - 1))
    vertices, faces = _without_empty_faces(vertices, faces.astype(np.int32))
    return vertices, faces, _normals(sample_density, vertices, faces, level, voxel / 2)


def remove_small_components(mesh: TriangleMesh, min_fraction: float) -> tuple[TriangleMesh, int]:
    """The mesh without connected parts of fewer than `min_fraction` of all faces, and how many parts went.

    Args:
        mesh: parts are connected through shared vertices.
        min_fraction: share of the faces, 0 (keep all) to 1; the largest part always stays.
    """
    if not 0 <= min_fraction <= 1:
        raise ConfigError(f"surface: min_fraction: expected 0 to 1, got {min_fraction}")
    if not len(mesh.faces):
        return mesh, 0
    try:
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components
    except ImportError as error:
        raise MissingExtraError("the mesh: needs scipy: pip install vfr-bake[export]") from error
    n_vertices = len(mesh.vertices)
    start, end = mesh.faces[:, [0, 1]].T.ravel(), mesh.faces[:, [1, 2]].T.ravel()
    edges = coo_matrix((np.ones(len(start), bool), (start, end)), (n_vertices, n_vertices))
    part = connected_components(edges, directed=False)[1][mesh.faces[:, 0]]
    n_faces = np.bincount(part)
    kept = n_faces >= min_fraction * len(mesh.faces)
    kept[n_faces.argmax()] = True
    n_removed = int(((n_faces > 0) & ~kept).sum())
    return (take_faces(mesh, kept[part]), n_removed) if n_removed else (mesh, 0)


def _sample_grid(
    sample_density: Density, axes: list[np.ndarray], level: float, progress: Callable[[float], object] | None
) -> tuple[np.ndarray, float, float]:
    """log(sigma / level), clipped, [nx, ny, nz] float32, and the range of sigma."""
    nx, ny, nz = map(len, axes)
    volume = np.empty((nx * ny, nz), np.float32)
    lowest, highest = math.inf, -math.inf
    step = max(_SLAB // nz, 1)
    for start in range(0, nx * ny, step):
        row = np.arange(start, min(start + step, nx * ny))
        points = np.empty((len(row), nz, 3), np.float32)
        points[..., 0] = axes[0][row // ny][:, None]
        points[..., 1] = axes[1][row % ny][:, None]
        points[..., 2] = axes[2]
        sigmas = _ask(sample_density, points.reshape(-1, 3))
        lowest, highest = min(lowest, float(sigmas.min())), max(highest, float(sigmas.max()))
        volume[row] = _clipped_log(sigmas, level).reshape(len(row), nz)
        if progress is not None:
            progress((int(row[-1]) + 1) / (nx * ny))
    return volume.reshape(nx, ny, nz), lowest, highest


def _ask(sample_density: Density, points: np.ndarray) -> np.ndarray:
    sigmas = np.asarray(sample_density(points))
    if sigmas.shape != (len(points),):
        raise DataError(f"surface: density: expected [{len(points)}] values, got {sigmas.shape}")
    if not (sigmas >= 0).all():  # false for NaN too
        raise DataError(f"surface: density: expected numbers >= 0, got {sigmas[~(sigmas >= 0)][0]}")
    return sigmas


def _clipped_log(sigmas: np.ndarray, level: float) -> np.ndarray:
    return np.log(np.clip(sigmas.astype(np.float64) / level, 1 / _CLIP, _CLIP))


def _without_empty_faces(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=-1) > 0]
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1).astype(np.int32)[faces]


def _normals(
    sample_density: Density, vertices: np.ndarray, faces: np.ndarray, level: float, step: float
) -> np.ndarray:
    """Central differences of the clipped log-density; where they vanish, the mean of the faces around, by
    area.
    """
    normals = np.zeros_like(vertices)
    for start in range(0, len(vertices), _SLAB):
        rows = slice(start, start + _SLAB)
        for axis in range(3):
            offset = np.zeros(3)
            offset[axis] = step
            before = _clipped_log(_ask(sample_density, (vertices[rows] - offset).astype(np.float32)), level)
            after = _clipped_log(_ask(sample_density, (vertices[rows] + offset).astype(np.float32)), level)
            normals[rows, axis] = before - after
    flat = np.linalg.norm(normals, axis=-1) < 1e-6
    if flat.any():
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        around = np.zeros_like(normals)
        for k in range(3):
            np.add.at(around, faces[:, k], np.cross(b - a, c - a) / step**2)
        normals[flat] = around[flat]
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
