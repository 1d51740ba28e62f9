"""What a level of a pyramid stores at its vertices, as bytes: `player.asset.coder` for vertices.

Rows are the vertices that are not on the border, in their order. The neighbours of a row are the vertices one
step along -z, -y and -x, where they are rows too; its class is how many of its three coordinates are odd,
which is between how many vertices of the coarser level it lies.
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
    """What is known about the rows of a level before their symbols are."""

    neighbours: Neighbours
    classes: np.ndarray
    """[n] uint8: how many coordinates of each row's vertex are odd."""


def level_rows(vertices: Vertices) -> LevelRows:
    """The rows of a level; every section of the level can use them.

    Takes 13 bytes a vertex, and 5 kB a brick of vertices meanwhile.
    """
    bricks = vertices.bricks
    stored = stored_bits(bricks.masks & ~vertices.border).reshape(-1)
    n = int(np.count_nonzero(stored))
    row_of_bit = np.full(len(stored) + BRICK**3, -1, np.int32)
    row_of_bit[: len(stored)][stored] = np.arange(n, dtype=np.int32)
    blocks = row_of_bit.reshape(-1, BRICK, BRICK, BRICK)  # the last is that of every brick that is not there
    neighbours = np.empty((3, n), np.int32)
    before = np.empty((len(bricks), BRICK, BRICK, BRICK), np.int32)
    for found, axis in zip(neighbours, (2, 1, 0), strict=True):
        step = BRICK ** (2 - axis)
        before.reshape(-1)[step:] = row_of_bit[: len(stored)][:-step]  # but for the first of each brick
        beside = bricks.find(bricks.coords.astype(np.int64) - np.eye(3, dtype=np.int64)[axis])
        across = (slice(None),) * axis
        before[(slice(None), *across, 0)] = blocks[(beside, *across, BRICK - 1)]
        found[:] = before.reshape(-1)[stored]
    classes = np.tile(_N_ODD, len(bricks))[stored]
    return LevelRows(Neighbours(neighbours), classes)


def encode_level(symbols: np.ndarray, rows: LevelRows) -> bytes:
    """The symbols [n, n_channels] of a level, or of some of its channels, as the bytes of a section.

    Symbols are integers from -255 to 255; the more of them are 0, the fewer bytes they take. Raises
    ShapeError: other shapes or symbols.
    """
    return encode(symbols, rows.neighbours, [rows.classes] * symbols.shape[1], N_CLASSES)


def decode_level(data: bytes, rows: LevelRows, n_channels: int, where: str) -> np.ndarray:
    """Undo `encode_level`: [n, n_channels] int16, which is contiguous channel by channel.

    `where` is the section's name in error messages. Raises FormatError: not a section of so many rows and
    channels; memory is bounded by their number and the length of `data`, time by their number.
    """
    return decode(data, rows.neighbours, [rows.classes] * n_channels, N_CLASSES, where)
