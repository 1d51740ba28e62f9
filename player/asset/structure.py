"""Encode and decode which bricks and cells a level of a pyramid has: an octree, from the coarse to the fine.

A level is coded relative to the next coarser one. An *octant* is 4 x 4 x 4 cells of a coarser brick, which
cover the same space as one brick of the finer level. First, each octant with a live cell has one symbol: 1 if
the finer level has a brick there, and the octant is *refined*. Then the *parents*, which are the live cells
of refined octants, have eight symbols each, one for each child: 1 if it is live. Child k = 4 x + 2 y + z is
at twice the parent's position plus (x, y, z).

The coarsest level is coded below imagined levels, each with half as many cells along each axis as the one
below it, rounded up, until there is one cell, which is live. All octants with live cells are refined there,
so that they need no symbols.

Both kinds of symbols are blocks of `player.asset.coder`. Octants, sorted by (x, y, z), are rows of one
channel and one class. Parents, sorted by octant and then by 16 x + 4 y + z within it, are rows of eight
channels. The class of a child is `live * 7 + dead`: of its six neighbours through a face at the finer level,
the numbers that are known to be live and to be dead. Known are the children of earlier channels; cells whose
parent is not live, which are dead; and cells whose parent is live in an octant that is not refined, which
count as live. The last child of a parent without another live child has the class 49, and must be live.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from player.asset.bricks import stored_bits
from player.asset.check_bricks import check_inside
from player.asset.coder.coder import Decoder, decode, encode
from player.asset.coder.lanes import Neighbours
from player.asset.pyramid import Bricks, Pyramid, coarser, packed_bits
from player.errors import FormatError, ShapeError

N_CHILDREN = 8
MUST = 49
N_CLASSES = 50
_DEAD, _LIVE, _UNKNOWN = 1, 7, 0
"""Number that a dead, a live or an unknown neighbour adds to the class of a child."""
_QUARTERS = np.array([[0x0F0F0F0F, 0xF0F0F0F0]], np.uint64) << np.array([[0], [32]], np.uint64)
"""[2, 2] uint64: the bits of a mask's word in each half along y (first index) and along z (second index)."""
_LENGTH = struct.Struct("<I")


class _Octants(NamedTuple):
    """The octants of a level that have live cells."""

    coords: np.ndarray
    """[n, 3] int64, sorted: coordinates of the bricks of the next finer level at the octants."""
    live: np.ndarray
    """[n, 4, 4, 4] bool: which cells of each octant are live."""


class _Parents(NamedTuple):
    """The live cells of refined octants."""

    octant: np.ndarray
    """[n] int64: index of each parent's octant among the refined ones."""
    local: np.ndarray
    """[n] int64: position of each parent in its octant, 16 x + 4 y + z."""
    beside: np.ndarray
    """[3, 2, n] int32: the rows of the cells before and after each parent along x, y and z; n for a cell that
    is not live, n + 1 for a live one in an octant that is not refined."""


def encode_structure(pyramid: Pyramid, level: int) -> bytes:
    """Encode the bricks and cells of a level, relative to those of the next coarser one.

    Raises ShapeError: a live cell of a refined octant has no live child, a live cell has no live parent, or
    the coarsest level has no live cell.
    """
    parts = []
    if level + 1 < len(pyramid.levels):
        octants = _octants(pyramid.levels[level + 1])
        refined = pyramid.levels[level].find(octants.coords) >= 0
        symbols = refined[:, None].astype(np.int16)
        parts.append(encode(symbols, *_octant_rows(octants)))
        parts.append(_encode_children(octants, refined, pyramid.levels[level]))
    else:
        above = [pyramid.levels[level]]
        if not len(above[0]):
            raise ShapeError("a pyramid: expected a live cell on its coarsest level, got none")
        for _ in range(_n_above(pyramid.cells_per_axis(level))):
            above.append(coarser(above[-1]))
        for parent, children in zip(above[:0:-1], above[-2::-1], strict=True):
            octants = _octants(parent)
            parts.append(_encode_children(octants, np.ones(len(octants.coords), bool), children))
    return b"".join(_LENGTH.pack(len(part)) + part for part in parts)


def decode_structure(
    data: bytes, cells_per_axis: int, parent: Bricks | None, n_bricks: int, where: str
) -> Bricks:
    """Undo `encode_structure`.

    Args:
        data: the bytes.
        cells_per_axis: cells of the level along each axis.
        parent: the bricks of the next coarser level; None for the coarsest.
        n_bricks: number of bricks that the level must have.
        where: the section's name in error messages.

    Returns:
        the level's bricks, each with a live cell; each live cell of a refined octant has a live child.

    Raises:
        FormatError: the data breaks the format, or has another number of bricks. Memory is bounded by the
            bricks of the two levels and the length of `data`.
    """
    parts = _parts(data, _n_above(cells_per_axis) if parent is None else 2, where)
    if parent is not None:
        octants = _octants(parent)
        neighbours, classes, n_classes = _octant_rows(octants)
        found = decode(parts[0], neighbours, classes, n_classes, where)[:, 0]
        refined = found == 1
        if not (refined | (found == 0)).all():
            raise FormatError(f"{where}: bricks: expected 0 or 1 for each octant, got others")
        if np.count_nonzero(refined) != n_bricks:
            raise FormatError(f"{where}: expected {n_bricks} bricks, got {np.count_nonzero(refined)}")
        bricks = _decode_children(parts[1], octants, refined, where)
    else:
        bricks = Bricks(np.zeros((1, 3), np.uint16), np.array([[1] + [0] * 7], np.uint64))
        for above, part in zip(range(len(parts))[::-1], parts, strict=True):
            octants = _octants(bricks)
            if len(octants.coords) > n_bricks:  # each octant holds at least one brick of the level
                raise FormatError(f"{where}: expected {n_bricks} bricks, got more at {above} levels above")
            bricks = _decode_children(part, octants, np.ones(len(octants.coords), bool), where)
        if len(bricks) != n_bricks:
            raise FormatError(f"{where}: expected {n_bricks} bricks, got {len(bricks)}")
    check_inside(bricks, cells_per_axis, "cells", where)
    return bricks


def _n_above(cells_per_axis: int) -> int:
    """Return the number of imagined levels above a level, until there is one cell."""
    return (cells_per_axis - 1).bit_length()


def _parts(data: bytes, n_parts: int, where: str) -> list[bytes]:
    """Split bytes into `n_parts` pieces, each of which follows its length."""
    parts, at = [], 0
    for _ in range(n_parts):
        if len(data) < at + _LENGTH.size:
            raise FormatError(f"{where}: expected {n_parts} blocks, got {len(parts)}")
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size + length
        parts.append(data[at - length : at])
    if at != len(data):
        raise FormatError(f"{where}: expected {at} bytes, got {len(data)}")
    return parts


def _octants(bricks: Bricks) -> _Octants:
    cells = stored_bits(bricks.masks).reshape(-1, 2, 4, 2, 4, 2, 4)
    words = np.bitwise_or.reduce(bricks.masks.reshape(-1, 2, 4), axis=2)
    brick, x, y, z = np.nonzero(words[:, :, None, None] & _QUARTERS)
    coords = bricks.coords.astype(np.int64)[brick] * 2 + np.stack([x, y, z], axis=-1)
    order = np.lexsort(coords.T[::-1])
    return _Octants(coords[order], cells[brick, x, :, y, :, z][order])


def _octant_rows(octants: _Octants) -> tuple[Neighbours, list[np.ndarray], int]:
    """Return the neighbours, classes and number of classes that `encode` needs for one symbol an octant."""
    named = _named(octants.coords)
    beside = [named.find(octants.coords - offset) for offset in np.eye(3, dtype=np.int64)[::-1]]
    neighbours = Neighbours(np.stack(beside).astype(np.int32))
    return neighbours, [np.zeros(neighbours.n, np.uint8)], 1


def _named(coords: np.ndarray) -> Bricks:
    """Return bricks with empty masks, for looking coordinates up."""
    return Bricks(coords, np.zeros((len(coords), 8), np.uint64))


def _parents(octants: _Octants, refined: np.ndarray) -> _Parents:
    used = octants.live & refined[:, None, None, None]
    n = int(np.count_nonzero(used))
    row = np.full((len(used) + 1, 4, 4, 4), n, np.int32)  # the last entry: octants without live cells
    flat = row[:-1].reshape(-1)
    flat[octants.live.reshape(-1)] = n + 1
    flat[used.reshape(-1)] = np.arange(n, dtype=np.int32)
    named = _named(octants.coords)
    beside = np.empty((3, 2, n), np.int32)
    for axis in range(3):
        offset = np.eye(3, dtype=np.int64)[axis]
        taken = np.moveaxis(row, axis + 1, 1)
        for side, next_to in enumerate((-offset, offset)):
            other = taken[named.find(octants.coords + next_to)]
            both = (other[:, -1:], taken[:-1, :-1]) if side == 0 else (taken[:-1, 1:], other[:, :1])
            beside[axis, side] = np.moveaxis(np.concatenate(both, axis=1), 1, axis + 1)[used]
    octant, local = np.nonzero(used[refined].reshape(-1, 64))
    return _Parents(octant, local, beside)


def _neighbours(parents: _Parents) -> Neighbours:
    before = parents.beside[::-1, 0]
    return Neighbours(np.where(before < before.shape[1], before, -1).astype(np.int32))


class _Children:
    """The states of the children in the channels known so far: live or dead."""

    def __init__(self, parents: _Parents) -> None:
        n = parents.beside.shape[2]
        self._beside = parents.beside
        self._known = np.full((N_CHILDREN, n + 2), _UNKNOWN, np.uint8)
        self._known[:, n], self._known[:, n + 1] = _DEAD, _LIVE

    def classes(self, child: int) -> np.ndarray:
        """Return the class [n] uint8 of child number `child` of every parent."""
        n = self._beside.shape[2]
        counts = np.zeros(n, np.uint8)
        for axis, bit in enumerate((4, 2, 1)):
            known = self._known[child ^ bit]
            counts += known[:n]
            counts += known.take(self._beside[axis, 1 if child & bit else 0])
        if child == N_CHILDREN - 1:
            counts[~(self._known[: N_CHILDREN - 1, :n] == _LIVE).any(axis=0)] = MUST
        return counts

    def tell(self, child: int, live: np.ndarray) -> None:
        """Note which of the children number `child` are live, [n] bool."""
        self._known[child, : len(live)] = np.where(live, np.uint8(_LIVE), np.uint8(_DEAD))


def _encode_children(octants: _Octants, refined: np.ndarray, children: Bricks) -> bytes:
    parents = _parents(octants, refined)
    at = children.find(octants.coords[refined])
    if (at < 0).any() or len(at) != len(children):
        raise ShapeError("a pyramid: expected bricks where the next coarser level has live cells")
    cells = stored_bits(children.masks)[at].reshape(-1, 4, 2, 4, 2, 4, 2)
    live = cells[_places(parents)].reshape(-1, N_CHILDREN)
    if np.count_nonzero(live) != np.count_nonzero(cells) or not live.any(axis=1).all():
        raise ShapeError("a pyramid: expected live children of live cells, and of each at least one")
    known, classes = _Children(parents), []
    for child in range(N_CHILDREN):
        classes.append(known.classes(child))
        known.tell(child, live[:, child])
    return encode(live.astype(np.int16), _neighbours(parents), classes, N_CLASSES)


def _decode_children(data: bytes, octants: _Octants, refined: np.ndarray, where: str) -> Bricks:
    parents = _parents(octants, refined)
    decoder = Decoder(data, _neighbours(parents), N_CHILDREN, N_CLASSES, where)
    known = _Children(parents)
    live = np.empty((N_CHILDREN, len(parents.octant)), bool)
    for child in range(N_CHILDREN):
        found = decoder.channel(known.classes(child))
        live[child] = found == 1
        if not (live[child] | (found == 0)).all():
            raise FormatError(f"{where}: cells: expected 0 or 1 for each child, got others")
        known.tell(child, live[child])
    decoder.finish()
    if not live.any(axis=0).all():
        raise FormatError(f"{where}: cells: expected a live child of each live cell, got none of some")
    coords = octants.coords[refined]
    cells = np.zeros((len(coords), 4, 2, 4, 2, 4, 2), bool)
    cells[_places(parents)] = live.T.reshape(-1, 2, 2, 2)
    return Bricks(coords.astype(np.uint16), packed_bits(cells.reshape(-1, 8, 8, 8)))


def _places(parents: _Parents) -> tuple:
    """Return the index of the children of each parent in an array [n_octants, 4, 2, 4, 2, 4, 2]."""
    x, y, z = parents.local >> 4, (parents.local >> 2) & 3, parents.local & 3
    return parents.octant, x, slice(None), y, slice(None), z, slice(None)
