"""Checks of the bricks of a pyramid, made when an asset is read or written."""

from __future__ import annotations

import numpy as np

from player.asset.bricks import unpack_vertices
from player.asset.pyramid import Bricks, coarser
from player.errors import FormatError


def check_level(bricks: Bricks, above: Bricks | None, n_cells: int, where: str) -> None:
    """Raise FormatError unless the bricks of a level are valid.

    They must be sorted, each once, inside the grid, and each must have a live cell. Where they refine an
    octant of the next coarser level, its live cells must be exactly those that hold a live cell of theirs.

    Args:
        bricks: the bricks of the level.
        above: the bricks of the next coarser level; None for the coarsest.
        n_cells: cells of the level along each axis.
        where: the level's name in error messages.
    """
    check_sorted(bricks.coords, where)
    check_inside(bricks, n_cells, "cells", where)
    empty = np.flatnonzero(~bricks.masks.any(axis=1))
    if len(empty):
        raise FormatError(f"{where}: expected a live cell in every brick, got none in brick {empty[0]}")
    if above is None:
        return
    below = coarser(bricks)
    octants = np.zeros((len(below), 2, 2, 2), bool)
    x, y, z = (bricks.coords & 1).T
    octants[below.find(bricks.coords >> 1), x, y, z] = True
    wrong = np.flatnonzero((below.masks != above.masks_at(below.coords) & _cells_of(octants)).any(axis=1))
    if len(wrong):
        raise FormatError(
            f"{where}: expected a live cell in each live cell of the coarser level that it refines, and in "
            f"no other: differs in brick {below.coords[wrong[0]].tolist()}"
        )


def _cells_of(octants: np.ndarray) -> np.ndarray:
    """Return masks [n, 8] uint64 with all cells set in those octants of bricks that `octants`, [n, 2, 2, 2]
    bool, selects."""
    bits = np.zeros((2, 2, 2, 8), np.uint64)
    for i, j, k in np.ndindex(2, 2, 2):
        word = sum(0xF << (8 * row + 4 * k) for row in range(4 * j, 4 * j + 4))
        bits[i, j, k, 4 * i : 4 * i + 4] = word
    found = np.zeros((len(octants), 8), np.uint64)
    for octant in np.ndindex(2, 2, 2):
        found |= np.where(octants[(slice(None), *octant)][:, None], bits[octant], np.uint64(0))
    return found


def check_sorted(coords: np.ndarray, where: str) -> None:
    """Raise FormatError unless coordinates of bricks [n, 3] are sorted by (x, y, z), each once."""
    x, y, z = np.asarray(coords, np.int64).T
    if (np.diff((x << 32) | (y << 16) | z) <= 0).any():
        raise FormatError(f"{where}: expected bricks sorted by x, y, z, each once")


def check_inside(bricks: Bricks, n: int, what: str, where: str) -> None:
    """Raise FormatError unless all cells (or vertices, as `what` says) that are set in the masks have
    coordinates below `n` along each axis."""
    n_bricks = -(-n // 8)
    if (bricks.coords >= n_bricks).any():
        raise FormatError(f"{where}: expected coordinates below {n_bricks}, got {bricks.coords.max()}")
    bits = np.arange(512)
    for axis, place in enumerate((bits >> 6, (bits >> 3) & 7, bits & 7)):
        beyond = np.packbits(place > ((n - 1) & 7), bitorder="little").view("<u8")
        edge = np.flatnonzero(bricks.coords[:, axis] == n_bricks - 1)
        wrong = edge[(bricks.masks[edge] & beyond).any(axis=1)]
        if len(wrong):
            found = unpack_vertices(bricks.coords[wrong[:1]], bricks.masks[wrong[:1]])
            raise FormatError(f"{where}: expected {what} below {n}, got one at {found[:, axis].max()}")
