"""Encode and decode the symbols at the vertices of a pyramid's level, with `player.asset.coder`.

Rows are the vertices that are not on the border, in their order. The neighbours of a row are the vertices one
step along -z, -y and -x, where these are rows too. The class of a row is how many of the vertex's three
coordinates are odd, that is, along how many axes it lies between two vertices of the coarser level.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.asset.bricks import BRICK, stored_bits
from player.asset.coder.coder import decode, encode
from player.asset.coder.lanes import Neighbours
from player.asset.pyramid import Vertices

N_CLASSES = 4

_LOCAL = np.indices((BRICK, BRICK, BRICK)).reshape(3, -1)
_N_ODD = (_LOCAL & 1).sum(axis=0).astype(np.uint8)


class LevelRows(NamedTuple):
    """The neighbours and classes of a level's rows, which must be known before their symbols are decoded."""

    neighbours: Neighbours
    classes: np.ndarray
    """[n] uint8: how many coordinates of each row's vertex are odd."""


def level_rows(vertices: Vertices) -> LevelRows:
    """Return the rows of a level, which serve all sections of its symbols.

    They take 13 bytes a vertex; while they are computed, 5 kB a brick of vertices are taken, too.
    """
    bricks = vertices.bricks
    stored = stored_bits(bricks.masks & ~vertices.border).reshape(-1)
    n = int(np.count_nonzero(stored))
    row_of_bit = np.full(len(stored) + BRICK**3, -1, np.int32)
    row_of_bit[: len(stored)][stored] = np.arange(n, dtype=np.int32)
    blocks = row_of_bit.reshape(-1, BRICK, BRICK, BRICK)  # the last stands for every missing brick
    neighbours = np.empty((3, n), np.int32)
    before = np.empty((len(bricks), BRICK, BRICK, BRICK), np.int32)
    for found, axis in zip(neighbours, (2, 1, 0), strict=True):
        step = BRICK ** (2 - axis)
        before.reshape(-1)[step:] = row_of_bit[: len(stored)][:-step]  # wrong in the first layers, set below
        beside = bricks.find(bricks.coords.astype(np.int64) - np.eye(3, dtype=np.int64)[axis])
        across = (slice(None),) * axis
        before[(slice(None), *across, 0)] = blocks[(beside, *across, BRICK - 1)]
        found[:] = before.reshape(-1)[stored]
    classes = np.tile(_N_ODD, len(bricks))[stored]
    return LevelRows(Neighbours(neighbours), classes)


def encode_level(symbols: np.ndarray, rows: LevelRows) -> bytes:
    """Encode the symbols [n, n_channels] of a level, or of some of its channels, as the bytes of a section.

    Symbols are integers from -255 to 255; the more of them are 0, the fewer bytes they take. Raises
    ShapeError: other shapes or symbols.
    """
    return encode(symbols, rows.neighbours, [rows.classes] * symbols.shape[1], N_CLASSES)


def decode_level(data: bytes, rows: LevelRows, n_channels: int, where: str) -> np.ndarray:
    """Undo `encode_level`: return [n, n_channels] int16, which is contiguous channel by channel.

    `where` is the section's name in error messages. Raises FormatError: not a section of so many rows and
    channels. Memory is bounded by the numbers of rows and channels and the length of `data`, time by these
    numbers.
    """
    return decode(data, rows.neighbours, [rows.classes] * n_channels, N_CLASSES, where)
