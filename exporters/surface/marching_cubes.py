"""The surface of a baked asset: marching cubes on its own sparse density, block by block.

Letters: c, the interpolated density code; sigma, the density, whose logarithm is linear in c
(`player.asset.density`); v, the size of a voxel; dt, the step of the march. The default level is the density
that is half opaque over two voxels or two steps, whichever are longer, sigma = ln 2 / (2 max(v, dt)). Fields
are soft at their surface, and of the levels that were tried this one is nearest to the player's outlines and
to known geometry (docs/notes/2026-11-21-surfaces.md). Only live cells are cut, which are those whose eight
corners are stored. Elsewhere no training view has seen anything, so it is unknown whether space is empty or
full; no surface is invented there, and the mesh is open where the live cells end.

Blocks are `BLOCK` cells wide and share the vertices of their faces, so that memory is bounded by the mesh and
not by the box. A vertex of the mesh lies on an edge of the grid, whose number identifies it in other blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from exporters.extras import needs
from exporters.shapes.mesh import Surface, has_three_corners, unit_normals
from player.asset.grid import SparseGrid
from player.errors import ConfigError, DataError, ShapeError
from player.progress import silent

BLOCK = 64
"""Cells along each side of a block, whose codes take 1 MB."""
# |log(sigma / level)| is clipped to this, so that empty space does not pull the surface towards it.
_CLIP = math.log(50.0)
_NUDGE = 1e-2  # least difference of a corner's code from the level, so that no vertex lies on a corner
_ROUNDS = 4  # steps of Newton's iteration; two reach 1e-3 of a voxel nearly everywhere
_REACH = 0.5  # most voxels that a vertex is moved by, at a stride of 1
_AT_ONCE = 1 << 18  # points processed at a time


class Cut(NamedTuple):
    """A surface as marching cubes cuts it, before its vertices are moved onto the level."""

    g: np.ndarray
    """[n_vertices, 3] float64, grid coordinates."""
    faces: np.ndarray
    """[n_faces, 3] int32, counter-clockwise seen from where the density is lower."""
    code_level: float
    """The level, as a density code."""
    stride: int
    """Voxels between the vertices of the grid that were used."""


def cut_surface(
    grid: SparseGrid,
    level: float | None = None,
    progress: Callable[[float], object] = silent,
    stride: int = 1,
) -> Cut:
    """Return roughly the surface where a grid's density equals `level`; `settled` moves it onto the level.

    Args:
        grid: the sparse grid, of one level.
        level: density in 1/model unit; None is `half_opaque`, or the geometric mean of the least and largest
            stored density if `half_opaque` is not between them.
        progress: called with the share done in (0, 1] after each block.
        stride: 2 uses only every second vertex along each axis and makes a quarter of the faces; a power of
            two up to BLOCK.

    Raises:
        ConfigError: the level is outside the stored densities; the message has their range.
        ShapeError: the grid has several levels (`exporters.surface.one_level` makes one of them).
        DataError: there is no live cell, or no surface in the live cells.
        MissingExtraError: scikit-image is not installed.
    """
    if grid.n_levels > 1:
        raise ShapeError(f"surface: expected a grid of one level, got {grid.n_levels} levels")
    code_level = _code_level(grid, level)
    corners, faces = [], []
    n_corners = 0
    blocks = _blocks(grid)
    for done, (block, slots) in enumerate(blocks, start=1):
        part = _cut(grid, block, slots, code_level, stride)
        if part is not None:
            corners.append(part[0])
            faces.append(part[1] + n_corners)
            n_corners += len(part[0])
        progress(done / len(blocks))
    if not n_corners:
        raise DataError("surface: expected a surface at this level, got none")
    g, triangles = _joined(np.concatenate(corners), np.concatenate(faces))
    return Cut(g * stride, triangles, code_level, stride)


def settled(grid: SparseGrid, cut: Cut) -> Surface:
    """Return the surface of a cut, in the model frame. Its vertices are on the level to a hundredth of a
    voxel where the density has a slope. Its normals point along the falling density or, where it does not
    fall, along the mean normal of the faces around, weighted by area."""
    g = onto_level(grid, cut.g, cut.code_level, cut.stride)
    vertices = grid.aabb_min.astype(np.float64) + g / grid.cells_per_unit.astype(np.float64)
    normals = unit_normals(_slopes(grid, g, cut.code_level), vertices, cut.faces, 0.1)
    return Surface(vertices, cut.faces, normals)


def voxel_size(grid: SparseGrid) -> float:
    """Return the edge of a voxel along x, model units."""
    return 1 / float(grid.cells_per_unit[0])


def half_opaque(grid: SparseGrid) -> float:
    """Return the density, in 1/model unit, that is half opaque over two voxels or two
    steps, whichever are longer."""
    return math.log(2) / (2 * max(voxel_size(grid), float(grid.step)))


def onto_level(grid: SparseGrid, g: np.ndarray, code_level: float, stride: int = 1) -> np.ndarray:
    """Move points [n, 3] float64 (grid coordinates) along the gradient of the code onto `code_level`.

    Newton's iteration moves a point by at most half of `stride` voxels in all. A point that leaves the live
    cells, or does not come nearer to the level, stays where it was.
    """
    moved = g.copy()
    for start in range(0, len(g), _AT_ONCE):
        here = g[start : start + _AT_ONCE].copy()
        first = here.copy()
        settled = np.zeros(len(here), bool)
        for _ in range(_ROUNDS):
            codes, slopes, known = code_and_slope(grid, here)
            square = np.sum(slopes**2, axis=-1)
            apart = code_level - codes
            usable = known & (square > 1.0) & ~settled  # a slope below a code per voxel may point anywhere
            step = np.where(usable, apart / np.where(usable, square, 1), 0)[:, None] * slopes
            candidate = here + step
            near = np.linalg.norm(candidate - first, axis=-1) <= _REACH * stride
            settled |= ~(usable & near)
            here = np.where(settled[:, None], here, candidate)
        end, _, known = code_and_slope(grid, here)
        begin, _, was_known = code_and_slope(grid, first)
        better = known & (~was_known | (np.abs(end - code_level) <= np.abs(begin - code_level)))
        moved[start : start + _AT_ONCE] = np.where(better[:, None], here, first)
    return moved


def code_and_slope(grid: SparseGrid, g: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the interpolated code [n] at points [n, 3] (grid coordinates), its gradient [n, 3] in codes per
    voxel, and whether the point is in a live cell, [n] bool. Outside live cells code and gradient are 0."""
    found = grid.find(g.T)
    known = np.all((g >= 0) & (g <= grid.resolution), axis=-1) & found.live
    at = found.corners
    share = [(1 - side, side) for side in found.fractions]
    codes, slopes = np.zeros(len(g)), np.zeros((len(g), 3))
    for x, y, z in np.ndindex(2, 2, 2):
        corner = grid.density.take(at + (x * 81 + y * 9 + z)).astype(np.float64)
        codes += corner * share[0][x] * share[1][y] * share[2][z]
        slopes[:, 0] += (2 * x - 1) * corner * share[1][y] * share[2][z]
        slopes[:, 1] += (2 * y - 1) * corner * share[0][x] * share[2][z]
        slopes[:, 2] += (2 * z - 1) * corner * share[0][x] * share[1][y]
    return np.where(known, codes, 0), np.where(known[:, None], slopes, 0), known


def _code_level(grid: SparseGrid, level: float | None) -> float:
    if not grid.live.any():
        raise DataError("surface: expected an asset with live cells, got none")
    low, slope = float(grid.density_low), float(grid.density_slope)
    lowest, highest = int(grid.codes.min()), int(grid.codes.max())
    least, most = math.exp(low + slope * lowest), math.exp(low + slope * highest)
    if level is None:
        level = half_opaque(grid)
        if not least < level < most:
            level = math.sqrt(least * most)
    if not (math.isfinite(level) and least < level < most):
        raise ConfigError(
            f"--level: expected a density between {least:.4g} and {most:.4g}, the range of the asset "
            f"(without it {half_opaque(grid):.4g}), got {level:g}"
        )
    return (math.log(level) - low) / slope


def _blocks(grid: SparseGrid) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the blocks that hold bricks: their places [3], counted in blocks, and
    the slots of their bricks."""
    owners, which = np.unique(grid.slot_coords // (BLOCK // 8), axis=0, return_inverse=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(which.reshape(-1), minlength=len(owners)))
    return list(zip(owners, np.split(order, ends[:-1]), strict=True))


def _cut(
    grid: SparseGrid, block: np.ndarray, slots: np.ndarray, code_level: float, stride: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the vertices (grid coordinates over `stride`) and faces of the surface in a block, or None."""
    with needs("the mesh", "scikit-image"):
        from skimage.measure import marching_cubes

    limit = _CLIP / float(grid.density_slope)
    volume = np.full((BLOCK + 1,) * 3, -limit, np.float32)
    live = np.zeros((BLOCK + 1,) * 3, bool)
    for slot in slots:
        x, y, z = grid.slot_coords[slot] * 8 - block * BLOCK
        values = np.clip(grid.codes[slot].reshape(9, 9, 9) - code_level, -limit, limit)
        near = np.abs(values) < _NUDGE
        values[near] = np.where(values[near] < 0, -_NUDGE, _NUDGE)
        volume[x : x + 9, y : y + 9, z : z + 9] = values
        bits = grid.live[slot * 64 : (slot + 1) * 64].reshape(8, 8, 1)
        # marching_cubes reads the mask at a cell's last corner to decide whether the cell is cut
        cells = np.unpackbits(bits, axis=2, bitorder="little")
        live[x + 1 : x + 9, y + 1 : y + 9, z + 1 : z + 9] = cells.astype(bool)
    if stride > 1:  # a coarser cell is live if a fine cell in it is; what is not stored is empty
        volume = np.ascontiguousarray(volume[::stride, ::stride, ::stride])
        n = BLOCK // stride
        cells = live[1:, 1:, 1:].reshape(n, stride, n, stride, n, stride).any(axis=(1, 3, 5))
        live = np.pad(cells, ((1, 0),) * 3)
    if not volume.min() < 0 < volume.max():
        return None
    try:
        corners, faces, _, _ = marching_cubes(volume, 0.0, gradient_direction="ascent", mask=live)
    except RuntimeError:  # the level is crossed, but in no live cell
        return None
    return corners.astype(np.float64) + block * (BLOCK // stride), faces.astype(np.int64)


def _joined(g: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge the vertices of all blocks that lie on the same edge of the grid; return them, and the faces that
    keep three different corners.

    A vertex that is on no edge is inside a cell, and belongs to its block alone.
    """
    nearest = np.rint(g)
    whole = np.abs(g - nearest) < 3e-5
    on_edge = whole.sum(axis=1) == 2
    start = np.where(whole, nearest, np.floor(g)).astype(np.int64)
    axis = np.argmin(whole, axis=1)
    name = ((start[:, 0] << 40) | (start[:, 1] << 20) | start[:, 2]) * 3 + axis
    name[~on_edge] = -1 - np.arange(int((~on_edge).sum()))
    _, first, number = np.unique(name, return_index=True, return_inverse=True)
    triangles = number.reshape(-1)[faces]
    return g[first], triangles[has_three_corners(triangles)].astype(np.int32)


def _slopes(grid: SparseGrid, g: np.ndarray, code_level: float) -> np.ndarray:
    """Return how steeply the code falls along the axes of the model frame [n, 3] at points `g` [n, 3], in
    codes per shortest edge of a voxel.

    The slopes are differences of the clipped code over half a voxel to both sides, or
    to the only stored side.
    """
    limit = _CLIP / float(grid.density_slope)
    slopes = np.zeros_like(g)
    for start in range(0, len(g), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
        here = np.clip(code_and_slope(grid, g[rows])[0] - code_level, -limit, limit)
        for axis in range(3):
            sides = []
            for sign in (-1, 1):
                codes, _, known = code_and_slope(grid, g[rows] + sign * 0.5 * np.eye(3)[axis])
                rise = sign * (np.clip(codes - code_level, -limit, limit) - here)
                sides.append(np.where(known, rise, np.nan))
            n_known = np.isfinite(sides).sum(axis=0)
            slopes[rows, axis] = -np.nansum(sides, axis=0) / np.maximum(n_known, 1)
    per_unit = grid.cells_per_unit.astype(np.float64)
    return slopes * (per_unit / per_unit.max())
