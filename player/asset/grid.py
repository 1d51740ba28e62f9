"""The sparse grid that rays are marched through, arranged in numpy from the pyramids of an asset.

Letters: R cells of the finest level per axis, nb bricks of the finest level per axis, C channels. A *place*
is the space of one brick of the finest level. A *slot* is the index of a brick, of any level, from which some
place is read. All arrays are flat, so that one integer addresses an element, in numpy as in compiled code:

    table      [nb^3] int32        at (bx * nb + by) * nb + bz for the place of this brick of the finest
                                   level: slot << 3 | level of the finest brick there. Without a brick there,
                                   minus the Chebyshev distance, in bricks of the finest level, to the nearest
                                   place that has one (at most MAX_DISTANCE). With `skip_dead`, a place where
                                   all cells of a coarser brick are dead counts as one without a brick. If
                                   samples of that brick's level stand for several steps, the entry is minus
                                   (level << DISTANCE_BITS | distance)
    live       [n_slots * 64] u8   at slot * 64 + x * 8 + y: bit z is set if the cell is live
    density    [n_slots * 729] u8  at slot * 729 + x * 81 + y * 9 + z, x, y, z = 0..8: codes with an apron, so
                                   that the eight corners of a cell are in one brick; SPARE bytes follow
    features   [n_vertices, C] int8, codes at the vertices of a separate pyramid over the same box, the rows
                                   of the finest level first; `rows` finds the row of a vertex

A slot's cells and vertices are those of its level: the cell of level l is that of the finest level >> l.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from player.asset.bricks import BRICK, bricks_per_axis, stored_bits, with_apron, with_corners
from player.asset.density import decode_constants
from player.asset.pyramid import Bricks, Pyramid, PyramidValues

SPARE = 2
"""Padding bytes behind the densities, because compiled code reads whole words."""

DISTANCE_BITS = 5
"""Bits of a distance in the table; the level of a dead brick is in the bits above them."""
MAX_DISTANCE = 31
"""Cap on distances: a longer jump saves nothing, and a fine grid is built in bounded time."""


CELLS_OF_LEVELS = np.float32(0.5) ** np.arange(8, dtype=np.float32)
"""Cells of each level per cell of the finest level, along an axis."""


@dataclass(frozen=True, eq=False)
class VertexRows:
    """Lookup table from the vertices of a pyramid to their rows in an array. Rows are sorted by level, the
    finest first, then by brick, then by bit (`player.asset.bricks`)."""

    resolution: int
    """Cells of the finest level per axis."""
    n_per_axis: int
    """Bricks of the finest level per axis, nb."""
    bricks: np.ndarray
    """[nb^3] int32 at (bx * nb + by) * nb + bz, for the place of this brick of the finest level: number << 3
    | level of the brick that holds the corners of the cells there; -1 where no corner is stored. Where no
    level has a brick, this is a brick of the finest of the levels that have a corner stored there."""
    rows: np.ndarray
    """[n_bricks * 729] int32 at number * 729 + x * 81 + y * 9 + z, x, y, z = 0..8: the row of a vertex, -1 if
    it is not stored. Bricks have an apron, so that the eight corners of a cell are in one brick."""


class LocatedPoints(NamedTuple):
    """Points located in a `SparseGrid`: the finest brick at each, and the cell of that brick's level."""

    entries: np.ndarray
    """[...] int32: entries of the grid's `table`."""
    cells: np.ndarray
    """[3, ...] int32: cells of the brick's level, or of the finest level where there is no brick."""
    fractions: np.ndarray
    """[3, ...]: positions of the points in these cells, 0..1, in the dtype of the points."""
    live: np.ndarray
    """[...] bool: whether each cell is live."""

    @property
    def corners(self) -> np.ndarray:
        """[...] int64: index in `density` of each cell's lowest corner; valid where there is a brick."""
        return corner_number(self.entries >> 3, self.cells)


@dataclass(frozen=True, eq=False)
class SparseGrid:
    """All data that a march reads; the arrays are described at the top of the module."""

    resolution: int
    n_per_axis: int
    aabb_min: np.ndarray
    """[3] float32, model frame."""
    cells_per_unit: np.ndarray
    """[3] float32: grid coordinate = (x - aabb_min) * cells_per_unit, 0..R."""
    step: np.float32
    """Distance between base samples in model units; dphi of `player.march.contracted` if contracted."""
    level_steps: np.ndarray
    """[n_levels] int32: the most base steps that one sample in a brick of each level stands for; powers of
    two that never decrease."""
    density_low: np.float32
    density_slope: np.float32
    slot_coords: np.ndarray
    """[n_slots, 3] int32: brick coordinate of each slot, in bricks of its level."""
    slot_levels: np.ndarray
    """[n_slots] int32: level of each slot."""
    table: np.ndarray
    live: np.ndarray
    density: np.ndarray
    rows: VertexRows
    features: np.ndarray
    contracted: bool = False
    """True if the box is all of space, contracted."""
    near: float = 0.0
    """Distance at which rays begin, in model units, if contracted."""

    @cached_property
    def places(self) -> np.ndarray:
        """[n, 3] int32: the places in which rays look for live cells, in bricks of the finest level."""
        found = np.flatnonzero(self.table >= 0)
        return np.stack(np.unravel_index(found, (self.n_per_axis,) * 3), axis=-1).astype(np.int32)

    @property
    def n_levels(self) -> int:
        """Levels of the densities."""
        return len(self.level_steps)

    @property
    def n_channels(self) -> int:
        return self.features.shape[1]

    def cells(self, g: np.ndarray) -> np.ndarray:
        """Return the cells [3, ...] int32 of the finest level that hold the points `g` [3, ...], in grid
        coordinates. Points on the far border, or outside the grid, are counted to the outermost cells."""
        return np.clip(g.astype(np.int32), 0, self.resolution - 1)

    def entries(self, cells: np.ndarray) -> np.ndarray:
        """Return the entries [...] of `table` for cells [3, ...] of the finest level."""
        return self.table.take(brick_number(cells, self.n_per_axis))

    def steps_at(self, entries: np.ndarray) -> np.ndarray:
        """Return the most base steps that a sample stands for if it begins where the table has `entries`."""
        taken = -entries >> DISTANCE_BITS
        steps = self.level_steps.take(np.where(entries < 0, taken, entries & 7), mode="clip")
        return np.where((entries < 0) & (taken == 0), 1, steps)

    @property
    def most_steps(self) -> int:
        """The most base steps that any sample stands for. A sample's steps always end before the next step
        whose index is a multiple of this number."""
        return int(self.level_steps[-1])

    def find(self, g: np.ndarray) -> LocatedPoints:
        """Locate the points `g` [3, ...], in grid coordinates."""
        cells = self.cells(g)
        entries = self.entries(cells)
        slots = np.maximum(entries >> 3, 0)
        if self.n_levels > 1:
            levels = np.where(entries < 0, 0, entries & 7)
            cells >>= levels
            g = g * CELLS_OF_LEVELS.take(levels)
        fractions = g - cells.astype(g.dtype)
        if len(self.live):
            x, y, z = cells & 7
            live = (entries >= 0) & (
                (self.live.take(slots * 64 + (x * 8 + y)) >> z.astype(np.uint8)) & 1 != 0
            )
        else:
            live = np.zeros(slots.shape, bool)
        return LocatedPoints(entries, cells, fractions, live)

    @property
    def codes(self) -> np.ndarray:
        """[n_slots, 729] uint8: the codes of the densities, slot by slot."""
        return self.density[: 729 * len(self.slot_coords)].reshape(-1, 729)

    @property
    def feature_scale(self) -> np.float32:
        """Cells of the features' finest level per cell of the densities' finest level, along an axis."""
        return np.float32(self.rows.resolution / self.resolution)

    @property
    def most_samples(self) -> int:
        """The number of base samples on the box's diagonal, plus three for rounding; no ray has more."""
        diagonal = float(np.linalg.norm(self.resolution / self.cells_per_unit.astype(np.float64)))
        return most_samples(diagonal, float(self.step))


def most_samples(diagonal: float, step: float) -> int:
    """Return the number of samples, `step` apart, on the diagonal of a box, plus three for rounding."""
    return int(diagonal / step) + 3


def brick_number(cells: np.ndarray, n_per_axis: int) -> np.ndarray:
    """Return the index [...] of the bricks of cells [3, ...] in a flat array with an element for each brick,
    `n_per_axis` along each axis.

    >>> int(brick_number(np.array([0, 9, 17]), 3))
    5
    """
    x, y, z = cells >> 3
    return (x * n_per_axis + y) * n_per_axis + z


def corner_number(bricks: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the index [...] of the lowest corners of cells [3, ...] in a flat array of bricks with an apron,
    9 x 9 x 9 vertices each. The next vertex is 81 further along x, 9 along y, 1 along z.

    Args:
        bricks: [...] the number of each cell's brick in the array; negative numbers count as 0.
        cells: [3, ...] cells of the bricks' levels.

    >>> int(corner_number(np.array(2), np.array([0, 9, 17])))
    1468
    """
    x, y, z = cells & 7
    return np.maximum(bricks, 0).astype(np.int64) * 729 + (x * 81 + y * 9 + z)


def build_grid(
    densities: PyramidValues,
    features: PyramidValues,
    aabb: np.ndarray,
    step: float,
    level_steps: Sequence[int],
    density_range: tuple[float, float],
    contracted: bool = False,
    near: float = 0.0,
    skip_dead: bool = False,
) -> SparseGrid:
    """Arrange the pyramids of an asset for marching.

    Args:
        densities: codes uint8 of one channel, already checked.
        features: codes int8, or float32 values in units of the codes.
        aabb: [2, 3] the box, model frame.
        step: distance between base samples, model units; dphi if contracted.
        level_steps: for each level of the densities, the most base steps that one sample stands for.
        density_range: log sigma at codes 0 and 255.
        contracted: whether the box is all of space, contracted.
        near: distance at which rays begin, model units, if contracted.
        skip_dead: treat places where all cells of a coarser brick are dead as places without a brick. Rays
            jump over them, and no picture changes.

    >>> from player.asset.bricks import pack_vertices
    >>> from player.asset.single_level import VertexBricks, from_vertices
    >>> coords, masks, _ = pack_vertices(np.argwhere(np.ones((5, 5, 5))))
    >>> codes = from_vertices(VertexBricks(coords, masks, np.zeros(125, np.uint8)), 4)
    >>> features = from_vertices(VertexBricks(coords, masks, np.zeros((125, 2), np.int8)), 4)
    >>> box = np.array([[-1] * 3, [1] * 3])
    >>> grid = build_grid(codes, features, box, 0.1, (1,), (0.0, 1.0))
    >>> grid.table.tolist(), int(np.bitwise_count(grid.live).sum())
    ([0], 64)
    """
    pyramid = densities.pyramid
    shown = [_shown(pyramid, level) for level in range(len(pyramid.levels))]
    coords, masks = [bricks.coords for bricks in shown], [bricks.masks for bricks in shown]
    table = _painted(pyramid, coords)
    _add_distances(table, _forget_dead(table, masks, level_steps) if skip_dead else None)
    low, slope = decode_constants(density_range)
    box = np.asarray(aabb, np.float64)
    values = features.values[0] if len(features.values) == 1 else np.concatenate(features.values)
    return SparseGrid(
        resolution=pyramid.resolution,
        n_per_axis=len(table),
        aabb_min=box[0].astype(np.float32),
        cells_per_unit=(pyramid.resolution / (box[1] - box[0])).astype(np.float32),
        step=np.float32(step),
        level_steps=np.array(level_steps, np.int32),
        density_low=low,
        density_slope=slope,
        slot_coords=np.concatenate(coords).astype(np.int32),
        slot_levels=np.repeat(np.arange(len(coords), dtype=np.int32), [len(some) for some in coords]),
        table=table.reshape(-1),
        live=np.concatenate(masks).astype("<u8").view(np.uint8).reshape(-1),
        density=_with_apron(densities, coords),
        rows=vertex_rows(features.pyramid),
        features=np.ascontiguousarray(values) if len(values) else np.zeros((1, values.shape[1]), np.int8),
        contracted=contracted,
        near=near,
    )


def vertex_rows(pyramid: Pyramid) -> VertexRows:
    """Return the lookup table of the rows of a pyramid's vertices.

    >>> from player.asset.pyramid import Bricks
    >>> one = Bricks(np.array([[0, 0, 0]], np.uint16), np.array([[1, 0, 0, 0, 0, 0, 0, 0]], np.uint64))
    >>> found = vertex_rows(Pyramid(8, (one,)))
    >>> found.bricks.tolist(), found.rows[[0, 1, 2, 9, 81, 91]].tolist()
    ([0], [0, 1, -1, 2, 4, 7])
    """
    # -2 - (number << 3 | level) stands for a place with a stored corner, but without a brick on any level
    owners = np.full((1, 1, 1), -1, np.int32)
    held: list[np.ndarray] = []
    n_held = 0
    for level in reversed(range(len(pyramid.levels))):
        owners = _refined(owners, pyramid, level)
        own = _shown(pyramid, level).coords.astype(np.int64)
        owners[tuple(own.T)] = np.arange(n_held, n_held + len(own), dtype=np.int32) << 3 | level
        corners = pyramid.vertices[level].bricks
        near = with_corners(corners.coords, corners.masks, len(owners))
        near = near[owners[tuple(near.T)] < 0]
        held.append(np.concatenate([own, near]))
        number = np.arange(n_held + len(own), n_held + len(held[-1]), dtype=np.int32)
        owners[tuple(near.T)] = -2 - (number << 3 | level)
        n_held += len(held[-1])
    np.copyto(owners, -2 - owners, where=owners < -1)
    apron = np.full((max(n_held, 1), 9, 9, 9), -1, np.int32)
    first_row = 0
    for level, vertices in enumerate(pyramid.vertices):
        wanted = held[-1 - level]
        stored = stored_bits(vertices.bricks.masks)
        rows = np.full((len(stored) + 1, stored.shape[1]), -1, np.int32)
        rows[:-1].reshape(-1)[stored.reshape(-1)] = np.arange(
            first_row, first_row + vertices.n, dtype=np.int32
        )
        first_row += vertices.n
        with_apron(rows, wanted, vertices.bricks.find, apron[n_held - len(wanted) : n_held])
        n_held -= len(wanted)
    return VertexRows(pyramid.resolution, len(owners), owners.reshape(-1), apron.reshape(-1))


def _shown(pyramid: Pyramid, level: int) -> Bricks:
    """Return the bricks of a level that finer bricks do not hide completely."""
    bricks = pyramid.levels[level]
    if level == 0:
        return bricks
    finer = pyramid.levels[level - 1].coords
    hidden = np.bincount(bricks.find(finer >> 1) + 1, minlength=len(bricks) + 1)[1:]
    halves = 2 * bricks.coords.astype(np.int64) + 1 < bricks_per_axis(pyramid.cells_per_axis(level - 1) - 1)
    shown = hidden < np.where(halves, 2, 1).prod(axis=1)
    return Bricks(bricks.coords[shown], bricks.masks[shown])


def _refined(owners: np.ndarray, pyramid: Pyramid, level: int) -> np.ndarray:
    """Expand `owners` [n, n, n] from the bricks of the next coarser level to the bricks of `level`."""
    n = bricks_per_axis(pyramid.cells_per_axis(level) - 1)
    if level + 1 == len(pyramid.levels):
        return np.full((n, n, n), owners[0, 0, 0])
    for axis in range(3):
        owners = owners.repeat(2, axis=axis)
    return owners[:n, :n, :n].copy()


def _with_apron(densities: PyramidValues, coords: Sequence[np.ndarray]) -> np.ndarray:
    """Return the codes, with an apron, of the bricks at `coords` [n, 3] of each level, level after level;
    flat, with SPARE bytes behind them."""
    pyramid, n_slots = densities.pyramid, sum(len(some) for some in coords)
    n_codes = (BRICK + 1) ** 3 * n_slots
    flat = np.zeros(n_codes + SPARE, np.uint8)
    apron = flat[:n_codes].reshape(-1, BRICK + 1, BRICK + 1, BRICK + 1)
    first = 0
    for level, (some, values) in enumerate(zip(coords, densities.values, strict=True)):
        vertices = pyramid.vertices[level].bricks
        stored = stored_bits(vertices.masks)
        dense = np.zeros((len(stored) + 1, stored.shape[1]), np.uint8)
        dense[:-1].reshape(-1)[stored.reshape(-1)] = values[:, 0]
        with_apron(dense, some, vertices.find, apron[first : first + len(some)])
        first += len(some)
    return flat


def _painted(pyramid: Pyramid, coords: Sequence[np.ndarray]) -> np.ndarray:
    """Return [nb, nb, nb] int32: slot << 3 | level of the finest brick at each place, -1 where there is none.

    The slots are the bricks at `coords` [n, 3] of each level, numbered level by level.
    """
    table = np.full((1, 1, 1), -1, np.int32)
    starts = np.cumsum([0, *(len(some) for some in coords)])
    for level in reversed(range(len(coords))):
        table = _refined(table, pyramid, level)
        slots = np.arange(starts[level], starts[level + 1], dtype=np.int32)
        table[tuple(coords[level].astype(np.int64).T)] = slots << 3 | level
    return table


def _forget_dead(table: np.ndarray, masks: Sequence[np.ndarray], level_steps: Sequence[int]) -> np.ndarray:
    """Take coarser bricks out of the `table` of `_painted`, in the places where all of their cells are dead.

    Returns [nb, nb, nb] int32: the level of the brick taken out; 0 where none was, or where samples of its
    level stand for one step.
    """
    entries, taken = table.reshape(-1), np.zeros(table.size, np.int32)
    first = len(masks[0])
    for level in range(1, len(masks)):
        places = np.flatnonzero((entries >= 0) & (entries & 7 == level))
        n = 1 << min(level, 3)  # parts of a brick along an axis, each at least one place wide
        cells = stored_bits(masks[level]).reshape(-1, n, 8 // n, n, 8 // n, n, 8 // n)
        alive: np.ndarray = np.asarray(cells.any(axis=(2, 4, 6)))
        at = np.stack(np.unravel_index(places, table.shape))
        part = (at & ((1 << level) - 1)) >> max(level - 3, 0)
        live = alive[((entries[places] >> 3) - first, *part)]
        dead = places[~live]
        entries[dead], taken[dead] = -1, level if level_steps[level] > 1 else 0
        first += len(masks[level])
    return taken.reshape(table.shape)


def _add_distances(table: np.ndarray, taken: np.ndarray | None) -> None:
    """Write minus the distance, and the levels of `taken`, to the places where a table has no brick.

    Each round grows the set of reached places by one brick on every side; a place's distance is the number of
    rounds that begin before it is reached.
    """
    reached = np.packbits(table >= 0, axis=2)  # eight places a byte, for speed: there are up to 31 rounds
    distance = np.zeros(table.shape, np.uint8)
    for _ in range(MAX_DISTANCE):
        missing = np.unpackbits(~reached, axis=2, count=table.shape[2])
        if not missing.any():
            break
        distance += missing
        reached = _dilated(reached)
    np.copyto(table, -distance.astype(np.int32), where=distance > 0)
    if taken is not None:
        table -= taken << DISTANCE_BITS


def _dilated(bits: np.ndarray) -> np.ndarray:
    """Return a set [n, n, n / 8] uint8, with a bit for each place along the last axis, grown by one place on
    every side."""
    grown = bits | bits << 1 | bits >> 1
    grown[:, :, 1:] |= bits[:, :, :-1] << 7
    grown[:, :, :-1] |= bits[:, :, 1:] >> 7
    for axis in (0, 1):
        along, moved = np.moveaxis(grown, axis, 0), np.moveaxis(grown.copy(), axis, 0)
        along[1:] |= moved[:-1]
        along[:-1] |= moved[1:]
    return grown
