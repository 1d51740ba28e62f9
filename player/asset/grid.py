"""The sparse grid as the march wants it: built from the arrays of an asset when it is opened, in numpy.

Letters: R cells per axis, nb bricks per axis, C channels; a slot is the number of a brick that has a live
cell. Everything is flat, so that one integer addresses it, in numpy as in compiled code:

    table      [nb^3] int32        at (bx * nb + by) * nb + bz: the slot, or minus the Chebyshev distance, in
                                   bricks, to the nearest brick with a live cell (at most MAX_DISTANCE)
    live       [n_slots * 64] u8   at slot * 64 + x * 8 + y: bit z tells whether the cell is live
    density    [n_slots * 729] u8  at slot * 729 + x * 81 + y * 9 + z, x, y, z = 0..8: codes with an apron, so
                                   that the eight corners of a cell are in one brick; SPARE bytes follow
    features   [n_vertices, C] int8, the vertices of a grid of its own over the same box, whose rows `rows`
                                   finds
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from player.asset.bricks import (
    BRICK,
    bricks_per_axis,
    dense_index,
    live_cells,
    stored_bits,
    with_apron,
    with_corners,
)
from player.asset.density import decode_constants

SPARE = 2
"""Bytes behind the densities: compiled code reads whole words."""

MAX_DISTANCE = 31
"""Distances are capped here: a longer jump saves nothing, and a fine grid is built in bounded time."""


@dataclass(frozen=True, eq=False)
class VertexRows:
    """Which row of an array holds which stored vertex of a grid. Rows are in the order of bricks, then of
    bits (`player.asset.bricks`)."""

    resolution: int
    """Cells per axis."""
    n_per_axis: int
    """Bricks per axis, nb."""
    bricks: np.ndarray
    """[nb^3] int32 at (bx * nb + by) * nb + bz: the brick that holds a cell, -1 where no corner of any cell
    is stored."""
    rows: np.ndarray
    """[n_bricks * 729] int32 at brick * 729 + x * 81 + y * 9 + z, x, y, z = 0..8: the row of a vertex, -1 if
    it is not stored. Bricks have an apron, so that the eight corners of a cell are in one."""

    def find(self, index: np.ndarray) -> np.ndarray:
        """Rows [n] int64 of vertices [n, 3] that may lie outside; -1 where none is stored."""
        inside = np.all((index >= 0) & (index < BRICK * self.n_per_axis), axis=-1)
        cells = np.where(inside[:, None], index, 0).T
        brick = self.bricks[brick_number(cells, self.n_per_axis)]
        row = self.rows[corner_number(brick, cells)]
        return np.where(inside & (brick >= 0), row, -1).astype(np.int64)


@dataclass(frozen=True, eq=False)
class SparseGrid:
    """What a march reads; the arrays are described at the top of the module."""

    resolution: int
    n_per_axis: int
    aabb_min: np.ndarray
    """[3] float32, model frame."""
    cells_per_unit: np.ndarray
    """[3] float32: grid coordinate = (x - aabb_min) * cells_per_unit, 0..R."""
    step: np.float32
    """Distance between lattice samples in model units; dphi of `player.march.contracted` if contracted."""
    density_low: np.float32
    density_slope: np.float32
    slot_coords: np.ndarray
    """[n_slots, 3] int32: brick coordinate of each slot."""
    table: np.ndarray
    live: np.ndarray
    density: np.ndarray
    rows: VertexRows
    features: np.ndarray
    contracted: bool = False
    """Whether the box is all of space, contracted."""
    near: float = 0.0
    """Where rays begin, model units, if contracted."""

    @property
    def n_channels(self) -> int:
        return self.features.shape[1]

    def cells(self, g: np.ndarray) -> np.ndarray:
        """The cells [3, ...] int32 that hold the points `g` [3, ...], grid coordinates. What is on the border
        belongs to the last cells, and so does what is beyond it."""
        return np.clip(g.astype(np.int32), 0, self.resolution - 1)

    def slots(self, cells: np.ndarray) -> np.ndarray:
        """The entries [...] of `table` for the bricks of cells [3, ...]."""
        return self.table.take(brick_number(cells, self.n_per_axis))

    def are_live(self, slots: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Whether cells [3, ...] are live, [...] bool, from the entries `slots` [...] of their bricks."""
        x, y, z = cells & 7
        bits = self.live.take(np.maximum(slots, 0) * 64 + (x * 8 + y)) >> z.astype(np.uint8)
        return ((bits & 1) != 0) & (slots >= 0)

    @property
    def codes(self) -> np.ndarray:
        """[n_slots, 729] uint8: the densities, slot by slot."""
        return self.density[: 729 * len(self.slot_coords)].reshape(-1, 729)

    @property
    def feature_scale(self) -> np.float32:
        """Cells of the features' grid in a cell of the density's."""
        return np.float32(self.rows.resolution / self.resolution)

    @property
    def most_samples(self) -> int:
        """The number of samples on the box's diagonal, and three for rounding: no ray is marched further."""
        diagonal = float(np.linalg.norm(self.resolution / self.cells_per_unit.astype(np.float64)))
        return most_samples(diagonal, float(self.step))


def most_samples(diagonal: float, step: float) -> int:
    """The number of samples, `step` apart, on a diagonal of a box, and three for rounding."""
    return int(diagonal / step) + 3


def brick_number(cells: np.ndarray, n_per_axis: int) -> np.ndarray:
    """Where in an array over all bricks, `n_per_axis` along each axis, those of cells [3, ...] are.

    >>> int(brick_number(np.array([0, 9, 17]), 3))
    5
    """
    x, y, z = cells >> 3
    return (x * n_per_axis + y) * n_per_axis + z


def corner_number(bricks: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Where in an array of bricks with an apron, of 9 x 9 x 9 vertices each, the lowest corners of cells
    [3, ...] are; its neighbours are 81 further along x, 9 along y, 1 along z.

    Args:
        bricks: [...] the number of each cell's brick among those that the array has; one below 0 counts as 0.
        cells: [3, ...].

    >>> int(corner_number(np.array(2), np.array([0, 9, 17])))
    1468
    """
    x, y, z = cells & 7
    return np.maximum(bricks, 0).astype(np.int64) * 729 + (x * 81 + y * 9 + z)


def build_grid(
    densities: tuple[np.ndarray, np.ndarray, np.ndarray],
    features: tuple[np.ndarray, np.ndarray, np.ndarray],
    resolutions: tuple[int, int],
    aabb: np.ndarray,
    step: float,
    density_range: tuple[float, float],
    contracted: bool = False,
    near: float = 0.0,
) -> SparseGrid:
    """Arrange the arrays of an asset for marching.

    Args:
        densities: coordinates and masks of the bricks, and codes, as on disk, already checked.
        features: the same of the features.
        resolutions: cells per axis of the two.
        aabb: [2, 3] the box, model frame.
        step: distance between lattice samples, model units; dphi if contracted.
        density_range: log sigma at codes 0 and 255.
        contracted: whether the box is all of space, contracted.
        near: where rays begin, model units, if contracted.

    >>> from player.asset.bricks import pack_vertices
    >>> coords, masks, _ = pack_vertices(np.argwhere(np.ones((5, 5, 5))))
    >>> codes, features = np.zeros(125, np.uint8), np.zeros((125, 2), np.int8)
    >>> box, range_ = np.array([[-1] * 3, [1] * 3]), (0.0, 1.0)
    >>> grid = build_grid((coords, masks, codes), (coords, masks, features), (4, 4), box, 0.1, range_)
    >>> grid.table.tolist(), int(np.bitwise_count(grid.live).sum())
    ([0], 64)
    """
    coords, masks, density = densities
    resolution, feature_resolution = resolutions
    n_per_axis = bricks_per_axis(resolution)
    index = dense_index(coords, n_per_axis)
    cells = live_cells(coords, masks, index)
    has_cells = np.flatnonzero(cells.any(axis=1))
    slots = np.full(len(coords), -1, np.int32)
    slots[has_cells] = np.arange(len(has_cells), dtype=np.int32)
    slot_coords = np.asarray(coords, np.int32)[has_cells]
    low, slope = decode_constants(density_range)
    box = np.asarray(aabb, np.float64)
    return SparseGrid(
        resolution=resolution,
        n_per_axis=n_per_axis,
        aabb_min=box[0].astype(np.float32),
        cells_per_unit=(resolution / (box[1] - box[0])).astype(np.float32),
        step=np.float32(step),
        density_low=low,
        density_slope=slope,
        slot_coords=slot_coords,
        table=_table(slot_coords, n_per_axis),
        live=np.ascontiguousarray(cells[has_cells], "<u8").view(np.uint8).reshape(-1),
        density=_with_apron(stored_bits(masks), density, coords, index, has_cells),
        rows=vertex_rows(*features[:2], feature_resolution),
        features=np.ascontiguousarray(features[2], np.int8),
        contracted=contracted,
        near=near,
    )


def vertex_rows(coords: np.ndarray, masks: np.ndarray, resolution: int) -> VertexRows:
    """The rows of the vertices of bricks, which are as they are on disk; at least one vertex is stored.

    >>> from player.asset.bricks import pack_vertices
    >>> coords, masks, _ = pack_vertices(np.array([[0, 0, 0], [9, 0, 0], [9, 0, 1]]))
    >>> vertex_rows(coords, masks, 16).find(np.array([[9, 0, 1], [0, 0, 0], [1, 0, 0], [-1, 0, 0]])).tolist()
    [2, 0, -1, -1]
    """
    n_per_axis = bricks_per_axis(resolution)
    stored = stored_bits(masks)
    rows = np.full((len(stored) + 1, stored.shape[1]), -1, np.int32)
    rows[:-1][stored] = np.arange(np.count_nonzero(stored), dtype=np.int32)
    held = with_corners(coords, masks, n_per_axis)
    apron = np.empty((len(held), 9, 9, 9), np.int32)
    with_apron(rows, held, dense_index(coords, n_per_axis), apron)
    bricks = dense_index(held, n_per_axis).reshape(-1)
    return VertexRows(resolution, n_per_axis, bricks, apron.reshape(-1))


def _with_apron(
    stored: np.ndarray, density: np.ndarray, coords: np.ndarray, index: np.ndarray, chosen: np.ndarray
) -> np.ndarray:
    dense = np.zeros((len(stored) + 1, stored.shape[1]), np.uint8)
    dense[:-1][stored] = density
    n_codes = (BRICK + 1) ** 3 * len(chosen)
    flat = np.zeros(n_codes + SPARE, np.uint8)
    apron = flat[:n_codes].reshape(-1, BRICK + 1, BRICK + 1, BRICK + 1)
    with_apron(dense, coords[chosen], index, apron)
    return flat


def _table(slot_coords: np.ndarray, n_per_axis: int) -> np.ndarray:
    """Slots, and elsewhere minus the Chebyshev distance: each round grows the reached set by one brick on
    every side."""
    reached = np.zeros((n_per_axis,) * 3, bool)
    where = tuple(slot_coords.T)
    reached[where] = True
    table = np.zeros(reached.shape, np.int32)
    for distance in range(1, MAX_DISTANCE + 1):
        table[~reached] = -distance
        for axis in range(3):
            reached = _dilate(reached, axis)
        if reached.all():
            break
    table[where] = np.arange(len(slot_coords), dtype=np.int32)
    return table.reshape(-1)


def _dilate(mask: np.ndarray, axis: int) -> np.ndarray:
    moved = np.moveaxis(mask, axis, 0)
    grown = moved.copy()
    grown[1:] |= moved[:-1]
    grown[:-1] |= moved[1:]
    return np.moveaxis(grown, 0, axis)
