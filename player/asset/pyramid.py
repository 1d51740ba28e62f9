"""A pyramid: one sparse grid at several levels of detail, where each place is as fine as it needs to be.

Level 0 is the finest, with R cells along each axis of the box; cells of level l are 2^l times as wide. A
brick is 8 x 8 x 8 cells of its level, and its coordinate is that of its lowest cell >> 3. The mask of a brick
says which of its cells are live, with the bits of `player.asset.bricks`.

The pyramid is whole: every live cell of a finer level lies in a live cell of the next coarser one, so that
the coarser levels alone make a picture, too. A place is read from the finest level that has a brick there. If
that brick's cell is not live, the place is empty.

The vertices of a level are the corners of its live cells. Their rows are sorted by brick, of 8 x 8 x 8
vertices each, and then by bit. A vertex is on the *border* of its level if it is also a corner of a place
that is read from a live cell of a coarser level. A level stores by how much its values differ from those of
the next coarser level, interpolated. On the border nothing is stored and they do not differ, so that the
field is continuous where levels meet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from player.asset.bricks import BRICK, bricks_per_axis, coords_of, keys_of, stored_bits, with_apron
from player.asset.prediction.prediction import Places, values_from

MAX_LEVELS = 8
_ROWS_AT_ONCE = 1 << 18
"""Vertices whose symbols are found at a time: the temporaries are eight times as wide as the 8-bit codes."""

_Z_FIRST = np.uint64(0x0101010101010101)  # the bits of a word with z = 0
_Z_LAST = np.uint64(0x8080808080808080)  # the bits of a word with z = 7
_ONE, _SEVEN, _EIGHT, _FIFTY_SIX = (np.uint64(n) for n in (1, 7, 8, 56))


@dataclass(frozen=True, eq=False)
class Bricks:
    """Bricks of one level, each with a mask."""

    coords: np.ndarray
    """[n_bricks, 3] uint16, sorted, each at most once."""
    masks: np.ndarray
    """[n_bricks, 8] uint64: which cells are live, or which vertices exist."""

    def __len__(self) -> int:
        return len(self.coords)

    @cached_property
    def _keys(self) -> np.ndarray:
        return keys_of(self.coords)

    def find(self, coords: np.ndarray) -> np.ndarray:
        """Return the index [n] int64 of the brick at each of the coordinates [n, 3]; -1 where there is none.

        >>> some = Bricks(np.array([[0, 0, 1], [2, 0, 0]], np.uint16), np.ones((2, 8), np.uint64))
        >>> some.find(np.array([[2, 0, 0], [0, 0, 0], [-1, 0, 0]])).tolist()
        [1, -1, -1]
        """
        if not len(self):
            return np.full(len(coords), -1)
        keys = keys_of(coords)
        index = np.minimum(np.searchsorted(self._keys, keys), len(self) - 1)
        return np.where(self._keys[index] == keys, index, -1)

    def masks_at(self, coords: np.ndarray) -> np.ndarray:
        """Return the masks [n, 8] uint64 at the coordinates [n, 3]; 0 where there is no brick."""
        index = self.find(coords)
        return np.where(index[:, None] >= 0, self.masks[index], 0) if len(self) else _no_masks(len(coords))

    def without_empty(self) -> Bricks:
        """Return the bricks whose masks are not all 0."""
        some = self.masks.any(axis=1)
        return self if some.all() else Bricks(self.coords[some], self.masks[some])


NO_BRICKS = Bricks(np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64))
"""The bricks of an empty level."""


def _no_masks(n: int) -> np.ndarray:
    return np.zeros((n, 8), np.uint64)


@dataclass(frozen=True, eq=False)
class Vertices:
    """The vertices of a level, in the order of their rows."""

    bricks: Bricks
    """Bricks of vertices; the masks say which vertices exist."""
    border: np.ndarray
    """[n_bricks, 8] uint64: which of these vertices are on the border."""

    @cached_property
    def n(self) -> int:
        return int(stored_bits(self.bricks.masks).sum())

    @cached_property
    def on_border(self) -> np.ndarray:
        """[n] bool: whether each vertex is on the border."""
        return stored_bits(self.border).reshape(-1)[stored_bits(self.bricks.masks).reshape(-1)]

    @cached_property
    def index(self) -> np.ndarray:
        """[n, 3] int32: positions of the vertices, in cells of the level."""
        brick, bit = np.nonzero(stored_bits(self.bricks.masks))
        local = np.stack([bit >> 6, (bit >> 3) & 7, bit & 7], axis=-1).astype(np.int32)
        return self.bricks.coords.astype(np.int32)[brick] * BRICK + local

    @cached_property
    def row_of_bit(self) -> np.ndarray:
        """[n_bricks * 512] int32: the row of each vertex of each brick, -1 where there is none."""
        there = stored_bits(self.bricks.masks).reshape(-1)
        rows = np.full(len(there), -1, np.int32)
        rows[there] = np.arange(self.n, dtype=np.int32)
        return rows

    def rows_of(self, part: Bricks) -> np.ndarray:
        """Return the rows [n] int32, ascending, of the vertices in `part`, a subset of these vertices.

        >>> brick = np.zeros((1, 3), np.uint16)
        >>> whole, part = (Bricks(brick, np.array([[bits] + [0] * 7], np.uint64)) for bits in (14, 10))
        >>> Vertices(whole, np.zeros((1, 8), np.uint64)).rows_of(part).tolist()
        [0, 2]
        """
        there = stored_bits(part.masks_at(self.bricks.coords))[stored_bits(self.bricks.masks)]
        return np.flatnonzero(there).astype(np.int32)

    def rows(self, index: np.ndarray) -> np.ndarray:
        """Return the rows [n] int32 of the vertices at the positions [n, 3]; -1 where there is none."""
        if not len(self.bricks):
            return np.full(len(index), -1, np.int32)
        brick = self.bricks.find(index >> 3)
        x, y, z = (index & 7).T
        return np.where(
            brick >= 0, self.row_of_bit.take(np.maximum(brick, 0) * 512 + (x * 64 + y * 8 + z)), -1
        )


@dataclass(frozen=True, eq=False)
class Pyramid:
    """The live cells of each level."""

    resolution: int
    """Cells of the finest level along each axis."""
    levels: tuple[Bricks, ...]
    """The bricks of each level, the finest first; the masks are those of live cells."""

    def cells_per_axis(self, level: int) -> int:
        return -(-self.resolution // (1 << level))

    def shown(self, level: int, coords: np.ndarray) -> np.ndarray:
        """Return masks [n, 8] uint64 of the cells of `level`, in bricks at `coords` [n, 3], that are read
        from live cells of this or a coarser level when all finer levels are left out."""
        bricks = self.levels[level]
        index = bricks.find(coords)
        masks = bricks.masks_at(coords)
        missing = np.flatnonzero(index < 0)
        if len(missing) and level + 1 < len(self.levels):
            around = coords[missing]
            masks[missing] = expanded(self.shown(level + 1, around >> 1), around & 1)
        return masks

    def with_level(self, level: int, bricks: Bricks) -> Pyramid:
        """Return this pyramid with other bricks on a level. Finer levels must have none. The vertices of the
        other levels do not change, and are not computed again."""
        levels, vertices = list(self.levels), list(self.vertices)
        levels[level] = bricks
        grown = Pyramid(self.resolution, tuple(levels))
        vertices[level] = grown._vertices(level)
        vars(grown)["vertices"] = tuple(vertices)
        return grown

    @cached_property
    def vertices(self) -> tuple[Vertices, ...]:
        """The vertices of each level."""
        return tuple(self._vertices(level) for level in range(len(self.levels)))

    def _vertices(self, level: int) -> Vertices:
        bricks = self.levels[level]
        corners = corners_of(bricks)
        if level + 1 == len(self.levels):
            return Vertices(corners, _no_masks(len(corners)))
        beside = _neighbourhood(bricks.coords, -1, 1)
        last = bricks_per_axis(self.cells_per_axis(level) - 1)
        inside = ((beside >= 0) & (beside < last)).all(axis=1)
        beside = beside[inside]
        beside = beside[bricks.find(beside) < 0]
        coarser = corners_of(Bricks(beside, self.shown(level, beside)).without_empty())
        border = corners.masks & coarser.masks_at(corners.coords)
        return Vertices(corners, border)


@dataclass(frozen=True, eq=False)
class PyramidValues:
    """A pyramid with the values at its vertices."""

    pyramid: Pyramid
    values: tuple[np.ndarray, ...]
    """For each level [n_vertices, n_channels] uint8 or int8 codes, a row for each vertex, those on the border
    included."""

    @cached_property
    def first_rows(self) -> np.ndarray:
        """[n_levels + 1] int64: the first row of each level when the rows of all levels follow one another,
        the finest first; the last entry is the number of all rows."""
        return np.cumsum([0, *(len(values) for values in self.values)])

    @property
    def n_channels(self) -> int:
        return self.values[0].shape[1]


def corners_of(cells: Bricks) -> Bricks:
    """Return the corners of live cells, as masks of bricks of vertices.

    Corners are added axis by axis: along z, then y, then x. Those behind a brick's last cells belong to the
    next brick.

    >>> one = Bricks(np.array([[0, 0, 0]], np.uint16), np.array([[1 << 63, 0, 0, 0, 0, 0, 0, 0]], np.uint64))
    >>> found = corners_of(one)
    >>> found.coords.tolist()
    [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1]]
    >>> np.flatnonzero(stored_bits(found.masks[3:])).tolist()
    [0, 64]
    """
    coords = _neighbourhood(cells.coords, 0, 1)
    masks = cells.masks_at(coords)

    def behind(masks: np.ndarray, *offset: int) -> np.ndarray:
        return Bricks(coords, masks).masks_at(coords - np.array(offset))

    masks = masks | ((masks & ~_Z_LAST) << _ONE) | ((behind(masks, 0, 0, 1) & _Z_LAST) >> _SEVEN)
    masks = masks | (masks << _EIGHT) | (behind(masks, 0, 1, 0) >> _FIFTY_SIX)
    before = np.concatenate([behind(masks, 1, 0, 0)[:, 7:], masks[:, :7]], axis=1)
    return Bricks(coords.astype(np.uint16), masks | before).without_empty()


def live_cells(vertices: Bricks) -> Bricks:
    """Return the cells with all eight corners among some vertices, as masks of bricks of cells.

    Corners are combined axis by axis: along z, then y, then x. A brick's last cells take their far corners
    from the first layer of the next brick.

    >>> nine = packed_bits(np.ones((8, 8, 8, 8), bool))
    >>> coords = np.argwhere(np.ones((2, 2, 2))).astype(np.uint16)
    >>> found = live_cells(Bricks(coords, nine))
    >>> found.coords[0].tolist(), np.bitwise_count(found.masks).sum(axis=1).tolist()
    ([0, 0, 0], [512, 448, 448, 392, 448, 392, 392, 343])
    >>> bool((corners_of(found).masks == nine).all())
    True
    """
    coords, masks = vertices.coords, vertices.masks

    def beyond(masks: np.ndarray, *offset: int) -> np.ndarray:
        return Bricks(coords, masks).masks_at(coords.astype(np.int64) + offset)

    along_z = ((masks >> _ONE) & ~_Z_LAST) | ((beyond(masks, 0, 0, 1) & _Z_FIRST) << _SEVEN)
    live = masks & along_z
    live = live & ((live >> _EIGHT) | (beyond(live, 0, 1, 0) << _FIFTY_SIX))
    live = live & np.concatenate([live[:, 1:], beyond(live, 1, 0, 0)[:, :1]], axis=1)
    return Bricks(coords, live).without_empty()


def _neighbourhood(coords: np.ndarray, low: int, high: int) -> np.ndarray:
    """Return the coordinates [n, 3] int64, sorted, that are at offsets with components from `low` to `high`
    from any of `coords`."""
    keys = keys_of(coords)
    offsets = np.arange(low, high + 1)
    for shift in (0, 20, 40):
        keys = np.unique((keys[:, None] + (offsets << shift)).reshape(-1))
    z = ((keys + (1 << 19)) & 0xFFFFF) - (1 << 19)  # components may be -1
    keys = (keys - z) >> 20
    y = ((keys + (1 << 19)) & 0xFFFFF) - (1 << 19)
    return np.stack([(keys - y) >> 20, y, z], axis=-1)


def expanded(masks: np.ndarray, octants: np.ndarray) -> np.ndarray:
    """Return masks of bricks of the next finer level, in which each cell of a brick's octant is eight cells.

    Args:
        masks: [n, 8] uint64 of the coarser bricks.
        octants: [n, 3] components 0 or 1: which half of each brick along each axis.

    >>> masks = expanded(np.array([[1, 0, 0, 0, 0, 0, 0, 0]], np.uint64), np.array([[0, 0, 0]]))
    >>> np.flatnonzero(stored_bits(masks)).tolist()
    [0, 1, 8, 9, 64, 65, 72, 73]
    """
    out = _no_masks(len(masks))
    some = np.flatnonzero(masks.any(axis=1))
    if len(some):
        cells = stored_bits(masks[some]).reshape(-1, 2, 4, 2, 4, 2, 4)
        x, y, z = octants[some].T
        cells = cells[np.arange(len(some)), x, :, y, :, z]
        for axis in (1, 2, 3):
            cells = cells.repeat(2, axis=axis)
        out[some] = packed_bits(cells)
    return out


def packed_bits(cells: np.ndarray) -> np.ndarray:
    """Pack cells [n, 8, 8, 8] bool into masks [n, 8] uint64."""
    bits = np.packbits(cells.reshape(-1, BRICK**3), axis=1, bitorder="little")
    return bits.view("<u8").astype(np.uint64, copy=False)


def coarser(bricks: Bricks) -> Bricks:
    """Return the bricks of the next coarser level whose live cells are those that hold a live cell of these.

    >>> fine = Bricks(np.array([[3, 0, 0]], np.uint16), np.array([[0, 0, 4, 0, 0, 0, 0, 0]], np.uint64))
    >>> found = coarser(fine)
    >>> found.coords.tolist(), np.flatnonzero(stored_bits(found.masks)).tolist()
    ([[1, 0, 0]], [321])
    """
    keys, owner = np.unique(keys_of(bricks.coords >> 1), return_inverse=True)
    coords = coords_of(keys)
    x, y, z = (bricks.coords & 1).T
    halved = _halved(bricks.masks) << (32 * y + 4 * z).astype(np.uint64)[:, None]
    whole = np.zeros((len(keys), 2, 4), np.uint64)
    for octant in range(8):  # each coarser brick has at most one of the bricks in it
        some = np.flatnonzero(x * 4 + y * 2 + z == octant)
        whole[owner.reshape(-1)[some], octant >> 2] |= halved[some]
    return Bricks(coords.astype(np.uint16), whole.reshape(-1, 8))


def _halved(masks: np.ndarray) -> np.ndarray:
    """Return [n, 4] uint64: which groups of 2 x 2 x 2 cells have a live one, laid out as the first octant of
    a brick: word x, bit y * 8 + z, with x, y and z below 4.

    >>> [hex(word) for word in _halved(np.array([[0, 1 << 63, 0, 0, 0, 0, 1 << 2, 0]], np.uint64))[0]]
    ['0x8000000', '0x0', '0x0', '0x2']
    """
    words = masks[:, 0::2] | masks[:, 1::2]
    words |= words >> _ONE
    words |= words >> _EIGHT
    for shift, kept in (  # compact every other bit of every other byte
        (0, 0x0055005500550055), (1, 0x0033003300330033), (2, 0x000F000F000F000F),
        (8, 0x00000F0F00000F0F), (16, 0x000000000F0F0F0F),
    ):  # fmt: skip
        words = (words | (words >> np.uint64(shift))) & np.uint64(kept)
    return words


def whole_pyramid(resolution: int, leaves: Sequence[Bricks]) -> Pyramid:
    """Return the pyramid whose level l has the live cells of `leaves[l]` and those that finer levels need.

    A place where a finer level has a brick is not read from a coarser one. The coarser level's own live cells
    there are dropped unless a finer level needs them.
    """
    levels = [leaves[0].without_empty()]
    for own in leaves[1:]:
        below = coarser(levels[-1])
        coords = coords_of(np.unique(np.concatenate([keys_of(own.coords), keys_of(below.coords)])))
        octants = np.zeros((len(coords), 2, 1, 2, 1, 2, 1), bool)
        at = Bricks(coords, _no_masks(len(coords))).find(levels[-1].coords >> 1)
        x, y, z = (levels[-1].coords & 1).T
        octants[at, x, :, y, :, z] = True
        refined = packed_bits(np.broadcast_to(octants, (len(coords), 2, 4, 2, 4, 2, 4)).reshape(-1, 8, 8, 8))
        masks = (own.masks_at(coords) & ~refined) | below.masks_at(coords)
        levels.append(Bricks(coords.astype(np.uint16), masks).without_empty())
    return Pyramid(resolution, tuple(levels))


def places_between(fine: Vertices, coarse: Vertices) -> Places:
    """Locate the vertices `coarse` of the next coarser level around the bricks of the vertices `fine`."""
    rows = np.append(coarse.row_of_bit, np.full(BRICK**3, -1, np.int32))
    apron = np.empty((len(coarse.bricks), BRICK + 1, BRICK + 1, BRICK + 1), np.int32)
    with_apron(rows, coarse.bricks.coords, coarse.bricks.find, apron)
    bricks = np.empty((len(fine.bricks), 4), np.int32)
    bricks[:, 0] = coarse.bricks.find(fine.bricks.coords >> 1)
    bricks[:, 1:] = (fine.bricks.coords & 1) * (BRICK // 2)
    return Places(bricks, apron.reshape(-1))


def predicted(fine: Vertices, coarse: Vertices, values: np.ndarray) -> np.ndarray:
    """Return the values that the next coarser level predicts at the vertices of a level.

    Args:
        fine: the n vertices of the level.
        coarse: the vertices of the next coarser level.
        values: [n_coarse, n_channels] integers, the values at these.

    Returns:
        [n, n_channels] int16: (the sum of the values at floor(v / 2) and ceil(v / 2) of each axis + 4) >> 3.
    """
    masks, none = fine.bricks.masks, np.zeros((0, values.shape[1]), np.int16)
    return values_from(masks, fine.border, places_between(fine, coarse), values, none, 1, (0, 0), np.int16)


def values_of(
    vertices: Sequence[Vertices],
    symbols: Sequence[np.ndarray],
    steps: Sequence[int],
    limits: tuple[int, int],
    dtype: type[np.generic] = np.int16,
) -> list[np.ndarray]:
    """Return the values of all levels, decoded from the symbols that each stores.

    Args:
        vertices: the vertices of each level, the finest first.
        symbols: for each level [n_stored, n_channels] integers, one row for each vertex that is not on the
            border: by how many steps the value differs from the coarser level's prediction; on the coarsest
            level, from 0. [0, n_channels] where all symbols of a level are 0.
        steps: for each level the quantization step, 1 or more.
        limits: the lowest and the highest value.
        dtype: dtype of the values.

    Returns:
        for each level [n, n_channels], a row for each vertex.
    """
    found: list[np.ndarray] = []
    for level in reversed(range(len(vertices))):
        here, change, step = vertices[level], symbols[level], steps[level]
        if found:
            places = places_between(here, vertices[level + 1])
            values = values_from(
                here.bricks.masks, here.border, places, found[-1], change, step, limits, dtype
            )
        else:
            values = np.zeros((here.n, change.shape[1]), dtype)
            values[: len(change)] = np.clip(step * change.astype(np.int32), *limits)
        found.append(values)
    return found[::-1]


def symbols_of(
    vertices: Sequence[Vertices], wanted: Sequence[np.ndarray], steps: Sequence[int], limits: tuple[int, int]
) -> list[np.ndarray]:
    """Return the symbols of each level with which `values_of` comes as close to `wanted` as the steps allow.

    The arguments are those of `values_of`, and `wanted`: for each level [n, n_channels] values, which need
    not be whole numbers.
    """
    found: list[np.ndarray] = []
    coarse: np.ndarray | None = None
    for level in reversed(range(len(vertices))):
        here, rows = vertices[level], np.flatnonzero(~vertices[level].on_border)
        if coarse is None:
            values = np.zeros(wanted[level].shape, np.int16)
        else:
            values = predicted(here, vertices[level + 1], coarse)
        symbols = np.empty((len(rows), wanted[level].shape[1]), np.int16)
        for first in range(0, len(rows), _ROWS_AT_ONCE):
            some = slice(first, first + _ROWS_AT_ONCE)
            before = values[rows[some]].astype(np.int32)
            away = np.rint((np.clip(wanted[level][rows[some]], *limits) - before) / steps[level])
            symbols[some] = away
            values[rows[some]] = np.clip(before + steps[level] * away.astype(np.int32), *limits)
        found.append(symbols)
        coarse = values
    return found[::-1]
