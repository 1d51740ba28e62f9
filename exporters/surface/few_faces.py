"""A mesh of an asset's surface with the wanted number of faces: the mesh that is baked into an asset, within
a limit of bytes, and the mesh that `vfr-export` writes by default.

First the grid is cut at a stride that still makes far more faces than are wanted. Vertices in the same small
cube are merged before they are moved onto the level, faces that no camera sees are removed, and edges are
collapsed where that changes the shape least (`exporters.mesh.simplify`). Without Open3D, only the stride
limits the number of faces.
"""

from __future__ import annotations

from exporters.formats.ply import small_ply_size
from exporters.mesh.simplify import clustered, mean_edge, simplify_mesh
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.asset_surface import AssetSurface, Removed
from exporters.surface.marching_cubes import BLOCK, Cut, cut_surface, settled
from player.asset.grid import SparseGrid
from player.errors import DataError, MissingExtraError

RESOLUTION = 128
"""Voxels along the box of a grid whose number of faces a mesh has by default."""
FINER = 3
"""Ratio of the faces that edge collapse starts from to those that are wanted. With 4, lego's mesh of 1.1 MB
is 0.2 dB nearer to the player's pictures, and takes a third longer."""
KEPT = 0.7
"""Rough share of the faces of a cut that cameras see (lego 0.7, the built-in scene 0.9)."""
FACE_BYTES = 21.5
"""Rough number of bytes that a face takes in an asset: 13 for itself and 15 for each of 0.57 vertices."""


def few_faces(
    surface: AssetSurface, resolution: int = RESOLUTION, max_bytes: int | None = None
) -> tuple[TriangleMesh, Removed]:
    """Return the surface at the default level as a white mesh, world frame, and what was removed from it.

    Args:
        surface: the asset's surface.
        resolution: the mesh has about as many faces as a grid of so many voxels along the box would give it,
            or fewer.
        max_bytes: bytes that the mesh may take in an asset; at least enough for a few faces.

    Raises:
        DataError: there is no surface, or nothing of it is seen, or nothing of it fits.
        MissingExtraError: scikit-image or scipy is not installed.
    """
    grid = surface.asset.grid
    stride = _stride(grid, resolution)
    while True:
        cut = cut_surface(grid, None, surface.on_cut, stride)
        share = min(resolution * stride / grid.resolution, 1.0) ** 2
        n_faces = len(cut.faces) * share * KEPT
        if max_bytes is not None:
            n_faces = min(n_faces, max_bytes / FACE_BYTES)
        try:
            thin = _thinned(cut, max(n_faces * FINER / KEPT, 1))
            mesh, removed = surface.cleaned(settled(grid, thin))
            at_most = len(mesh.faces) * share * len(cut.faces) / len(thin.faces)
            return _within(mesh, max(round(at_most), 1), max_bytes), removed
        except MissingExtraError:  # no Open3D
            mesh, removed = surface.cleaned(settled(grid, cut))
            if not _is_larger(mesh, max_bytes) or stride == BLOCK:
                return mesh, removed
            stride *= 2


def _stride(grid: SparseGrid, resolution: int) -> int:
    """Return the largest stride at which the grid is still cut at least twice as
    finely per axis as is wanted."""
    stride = 1
    while grid.resolution >= 4 * stride * resolution and stride < BLOCK:
        stride *= 2
    return stride


def _thinned(cut: Cut, n_faces: float) -> Cut:
    """Return the cut reduced to about `n_faces` faces; unchanged if it has less than 1.5 times as many."""
    ratio = len(cut.faces) / n_faces
    if ratio < 1.5:
        return cut
    g, faces = clustered(cut.g, cut.faces, mean_edge(cut.g, cut.faces) * ratio**0.5)
    return cut._replace(g=g, faces=faces) if len(faces) else cut


def _within(mesh: TriangleMesh, n_faces: int, max_bytes: int | None) -> TriangleMesh:
    """Return a white mesh reduced to at most `n_faces` faces and at most `max_bytes`.

    Raises DataError: so few faces cannot be reached.
    """
    while True:
        mesh = simplify_mesh(mesh, max(n_faces, 1))
        if len(mesh.faces) > n_faces:
            raise DataError(f"surface: expected one that fits into {n_faces} faces, got specks alone")
        if max_bytes is None or not _is_larger(mesh, max_bytes):
            return mesh
        size = small_ply_size(len(mesh.vertices), len(mesh.faces))
        n_faces = int(0.99 * len(mesh.faces) * max_bytes / size)


def _is_larger(mesh: TriangleMesh, max_bytes: int | None) -> bool:
    return max_bytes is not None and small_ply_size(len(mesh.vertices), len(mesh.faces)) > max_bytes
