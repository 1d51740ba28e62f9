"""Bricks: the layout of a sparse set of grid vertices.

A brick is 8 x 8 x 8 vertices; its coordinate is the vertex index >> 3, and bricks are sorted by (x, y, z).
A brick's mask is eight 64-bit words: vertex (x, y, z) is bit `b = (x & 7) * 64 + (y & 7) * 8 + (z & 7)`, in
word `b >> 6` (so the word is x & 7) at bit `b & 63`. Rows of values follow the set bits: by brick, then by b.

A cell is named by its lowest vertex. Masks of live cells (`player.asset.pyramid`) have the same bits.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

BRICK = 8
"""Vertices, or in a pyramid cells, along each edge of a brick."""

Find = Callable[[np.ndarray], np.ndarray]
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_Y_FIRST = np.uint64(0xFF)  # the bits of a word with y = 0
_Z_FIRST = np.uint64(0x0101010101010101)  # the bits of a word with z = 0


def bricks_per_axis(resolution: int) -> int:
    """Return the bricks along each axis of a grid of `resolution` cells, that is `resolution + 1` vertices.

    >>> bricks_per_axis(7), bricks_per_axis(8), bricks_per_axis(512)
    (1, 2, 65)
    """
    return -(-(resolution + 1) // BRICK)


def keys_of(coords: np.ndarray) -> np.ndarray:
    """Return a number [n] int64 for each of the coordinates [n, 3], from -1 to 2^19. The numbers rise with
    (x, y, z).

    >>> keys = keys_of(np.array([[0, 1, 0], [1, 0, 0]]))
    >>> (keys[0] < keys[1]).item(), coords_of(keys).tolist()
    (True, [[0, 1, 0], [1, 0, 0]])
    """
    x, y, z = np.asarray(coords, np.int64).T
    return (x << 40) + (y << 20) + z


def coords_of(keys: np.ndarray) -> np.ndarray:
    """Return the coordinates [n, 3] int64, of 0 and more, of `keys_of` coordinates [n]."""
    return np.stack([keys >> 40, (keys >> 20) & 0xFFFFF, keys & 0xFFFFF], axis=-1)


def pack_vertices(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pack vertices into bricks.

    Args:
        vertices: [n_vertices, 3] integer grid indices, each at most once, in any order.

    Returns:
        brick_coords: [n_bricks, 3] uint16, sorted.
        brick_masks: [n_bricks, 8] uint64.
        order: [n_vertices] int64; `vertices[order]` is the order of the rows on disk.

    >>> brick_coords, brick_masks, order = pack_vertices(np.array([[9, 0, 0], [0, 0, 1], [0, 0, 0]]))
    >>> brick_coords.tolist(), brick_masks[:, :2].tolist(), order.tolist()
    ([[0, 0, 0], [1, 0, 0]], [[3, 0], [0, 1]], [2, 1, 0])
    """
    vertices = np.asarray(vertices, np.int64).reshape(-1, 3)
    high, low = vertices >> 3, vertices & 7
    bits = (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]
    keys = keys_of(high)
    order = np.lexsort((bits, keys))
    keys, index = np.unique(keys, return_inverse=True)
    coords = coords_of(keys).astype(np.uint16)
    stored = np.zeros((len(keys), 512), bool)
    stored[index.reshape(-1), bits] = True
    masks = np.packbits(stored, axis=1, bitorder="little").view("<u8").astype(np.uint64).reshape(-1, 8)
    return coords, masks, order


def stored_bits(brick_masks: np.ndarray) -> np.ndarray:
    """Unpack masks [n_bricks, 8] to [n_bricks, 512] bool, indexed by b.

    >>> np.flatnonzero(stored_bits(np.array([[5, 1, 0, 0, 0, 0, 0, 0]], np.uint64))).tolist()
    [0, 2, 64]
    """
    octets = np.ascontiguousarray(brick_masks, "<u8").view(np.uint8).reshape(-1, 64)
    return np.unpackbits(octets, axis=1, bitorder="little").view(bool)


def unpack_vertices(brick_coords: np.ndarray, brick_masks: np.ndarray) -> np.ndarray:
    """Return the stored vertices [n_vertices, 3] int64 in the order of the rows; undoes `pack_vertices`.

    >>> masks = np.array([[2, 0, 0, 0, 0, 0, 0, 1]], np.uint64)
    >>> unpack_vertices(np.array([[1, 0, 2]], np.uint16), masks).tolist()
    [[8, 0, 17], [15, 0, 16]]
    """
    brick, bit = np.nonzero(stored_bits(brick_masks))
    local = np.stack([bit >> 6, (bit >> 3) & 7, bit & 7], axis=-1)
    return np.asarray(brick_coords, np.int64)[brick] * BRICK + local


def dense_index(brick_coords: np.ndarray, n_per_axis: int) -> np.ndarray:
    """Return [n, n, n] int32: the index of the brick at each coordinate, -1 where there is none."""
    index = np.full((n_per_axis,) * 3, -1, np.int32)
    index[tuple(np.asarray(brick_coords, np.int64).T)] = np.arange(len(brick_coords), dtype=np.int32)
    return index


def with_apron(values: np.ndarray, brick_coords: np.ndarray, find: Find, out: np.ndarray) -> None:
    """Write the values of bricks with an apron to `out` [n, 9, 9, 9].

    The apron holds the first vertices of the next bricks behind a brick's own last ones, so that the eight
    corners of each cell are in one brick.

    Args:
        values: [n_bricks + 1, 512], indexed by b; the last row stands for every missing brick.
        brick_coords: [n, 3] coordinates of the wanted bricks.
        find: called with coordinates [n, 3]; returns the index [n] of each brick in `values`, -1 where there
            is none.
        out: written here; has the dtype of `values`.
    """
    blocks, coords = values.reshape(-1, BRICK, BRICK, BRICK), np.asarray(brick_coords, np.int64)
    for offset in np.ndindex(2, 2, 2):
        into = tuple(slice(BRICK, None) if o else slice(BRICK) for o in offset)
        take = tuple(slice(1) if o else slice(None) for o in offset)
        out[(slice(None), *into)] = blocks[(slice(None), *take)][find(coords + offset)]


def with_corners(brick_coords: np.ndarray, brick_masks: np.ndarray, n_per_axis: int) -> np.ndarray:
    """Return the coordinates [n, 3] int64, sorted, of the bricks in which a cell has a stored corner, which
    may lie in the next brick.

    >>> coords, masks, _ = pack_vertices(np.array([[8, 1, 0]]))
    >>> with_corners(coords, masks, 2).tolist()
    [[0, 0, 0], [1, 0, 0]]
    """
    found = np.zeros((n_per_axis,) * 3, bool)
    coords, masks = np.asarray(brick_coords, np.int64), np.asarray(brick_masks, np.uint64)
    some = (np.bitwise_or.reduce(masks, axis=1), masks[:, 0])  # vertices at any x of a brick; at its first x
    for offset in np.ndindex(2, 2, 2):
        words = some[offset[0]] & (_Y_FIRST if offset[1] else _ALL) & (_Z_FIRST if offset[2] else _ALL)
        before = coords - offset
        wanted = (words != 0) & ((before >= 0) & (before < n_per_axis)).all(axis=1)
        found[tuple(before[wanted].T)] = True
    return np.argwhere(found)
