"""Leave out cells that hardly any ray sees.

At first, a cell is stored if one sample in it weighs enough in one view (`vfr_bake.baking.cells`). That says
little: unseen space holds whatever training left there, and a single ray of thousands may touch it. Here, the
weights of all samples are summed over the rays of many views, in blocks of 2 x 2 x 2 cells. The blocks that
weigh least are left out, as many as can be without losing more than next to nothing on training pixels.

Let W_b be the sum in block b. To give up a share q of the weight, leave out the blocks of lowest W_b, as many
as have sum_b W_b <= q sum W.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numba import get_num_threads

from player.asset.bricks import bricks_per_axis, dense_index, unpack_vertices
from player.asset.grid import SparseGrid
from player.asset.pyramid import Bricks, corners_of, packed_bits
from player.cameras.camera import Camera
from player.compiled.samples import sample_rays
from player.progress import Progress
from vfr_bake.baking.grids import GridVertices, Layout
from vfr_bake.kernels.sample_weights import BLOCKS, add_block_weights

RAYS_AT_ONCE = 1 << 14
BRICKS_AT_ONCE = 1 << 12


def block_weights(grid: SparseGrid, cameras: list[Camera], n_rays: int, progress: Progress) -> np.ndarray:
    """Return [n_bricks, 4, 4, 4] float64: for each block of 2 x 2 x 2 cells in the bricks of a grid of one
    level, the summed weights of the samples of about `n_rays` rays.

    Args:
        grid: the grid as the player has it.
        cameras: views in the model frame; the rays are spread evenly over all their pixels.
        n_rays: rough number of rays; no pixel has more than one.
        progress: called with (cameras done, cameras in all).
    """
    totals = np.zeros(len(grid.slot_coords) * BLOCKS**3)
    share = min(np.sqrt(n_rays / sum(camera.width * camera.height for camera in cameras)), 1.0)
    for index, camera in enumerate(cameras):
        rays_o, rays_d = camera.scaled(share).rays()
        for first in range(0, len(rays_o), RAYS_AT_ONCE):
            rows = slice(first, first + RAYS_AT_ONCE)
            met = sample_rays(grid, rays_o[rows], rays_d[rows], get_num_threads())
            add_block_weights(
                met.points, met.samples.weights, grid.table, grid.n_per_axis, grid.resolution, totals
            )
        progress(index + 1, len(cameras))
    return totals.reshape(-1, BLOCKS, BLOCKS, BLOCKS)


def heavy_blocks(weights: np.ndarray, share: float) -> np.ndarray:
    """Return the blocks that are kept, as bool of the shape of `weights`, if those that weigh least are left
    out, up to `share` of the whole weight. Blocks without weight are always left out.

    >>> heavy_blocks(np.array([0.0, 6.0, 1.0, 3.0]), 0.15).tolist()
    [False, True, False, True]
    """
    order = np.argsort(weights, axis=None)
    running = np.cumsum(weights.reshape(-1)[order])
    kept = np.empty(weights.size, bool)
    kept[order] = running > share * running[-1]
    return kept.reshape(weights.shape) & (weights > 0)


def live_of_blocks(blocks: np.ndarray) -> np.ndarray:
    """Return masks [n_bricks, 8] uint64 of the cells in the marked `blocks` [n_bricks, 4, 4, 4] bool.

    >>> masks = live_of_blocks(np.arange(64).reshape(1, 4, 4, 4) == 1)
    >>> unpack_vertices(np.zeros((1, 3), np.uint16), masks).tolist()
    [[0, 0, 2], [0, 0, 3], [0, 1, 2], [0, 1, 3], [1, 0, 2], [1, 0, 3], [1, 1, 2], [1, 1, 3]]
    """
    for axis in (1, 2, 3):
        blocks = blocks.repeat(2, axis=axis)
    return packed_bits(blocks)


class KeptVertices(NamedTuple):
    """The kept vertices of a grid."""

    vertices: GridVertices
    rows: np.ndarray
    """[n] int32, ascending: the rows of these vertices among all vertices of the grid."""


def corners_within(vertices: GridVertices, cells: Bricks) -> KeptVertices:
    """Return the corners of `cells`, which are a part of the cells that have `vertices` as corners."""
    corners = corners_of(cells)
    rows = vertices.pyramid.vertices[0].rows_of(corners)
    return KeptVertices(
        GridVertices(corners.coords, corners.masks, vertices.index[rows], vertices.resolution), rows
    )


def overlapping(cells: Bricks, resolution: int, others: Bricks, of_others: int) -> Bricks:
    """Return those cells of `others` that overlap one of `cells`.

    Both cover the same box: `others` with `of_others` cells along each axis, `cells` with `resolution`, which
    is as many or more.

    >>> cells = Bricks(np.zeros((1, 3), np.uint16), np.array([[1 << 2, 0, 0, 0, 0, 0, 0, 0]], np.uint64))
    >>> every = Bricks(np.zeros((1, 3), np.uint16), np.full((1, 8), ~np.uint64(0)))
    >>> found = overlapping(cells, 8, every, 5)  # 2/8 to 3/8 of the edge: 1.25 to 1.875 of its cells
    >>> unpack_vertices(found.coords, found.masks).tolist()
    [[0, 0, 1]]
    """
    table = dense_index(others.coords, bricks_per_axis(of_others))
    marked = np.zeros(len(others) * 512, bool)
    for first in range(0, len(cells), BRICKS_AT_ONCE):
        rows = slice(first, first + BRICKS_AT_ONCE)
        index = unpack_vertices(cells.coords[rows], cells.masks[rows])
        ends = index * of_others // resolution, ((index + 1) * of_others - 1) // resolution
        for corner in product((0, 1), repeat=3):
            at = np.stack([ends[end][:, axis] for axis, end in enumerate(corner)], axis=-1)
            where = table[tuple((at >> 3).T)].astype(np.int64)
            x, y, z = (at & 7).T
            marked[(where * 512 + x * 64 + y * 8 + z)[where >= 0]] = True
    masks = others.masks & packed_bits(marked.reshape(-1, 8, 8, 8))
    return Bricks(others.coords, masks).without_empty()


class Thinned(NamedTuple):
    """The remaining part of a layout, and the rows that it keeps."""

    layout: Layout
    densities: np.ndarray
    """[n_densities] int32, ascending: rows of the densities that are kept."""
    features: np.ndarray
    """[n_features] int32, ascending: rows of the features that are kept."""


def thinned(layout: Layout, blocks: np.ndarray) -> Thinned:
    """Return the layout without the densities outside the kept `blocks` [n_bricks, 4, 4, 4] bool, and without
    the features where no density is left."""
    (cells,) = layout.densities.pyramid.levels
    cells = Bricks(cells.coords, cells.masks & live_of_blocks(blocks)).without_empty()
    densities = corners_within(layout.densities, cells)
    if layout.features is layout.densities:
        features = densities
    else:
        (others,) = layout.features.pyramid.levels
        fine, coarse = layout.densities.resolution, layout.features.resolution
        features = corners_within(layout.features, overlapping(cells, fine, others, coarse))
    left = replace(layout, densities=densities.vertices, features=features.vertices)
    return Thinned(left, densities.rows, features.rows)
