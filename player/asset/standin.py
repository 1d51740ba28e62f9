"""Stand-in for the coder, until it is there."""

from __future__ import annotations

import zlib

import numpy as np

from player.asset.pyramid import Bricks
from player.errors import FormatError


def _packed(array: np.ndarray) -> bytes:
    return zlib.compress(np.ascontiguousarray(array).tobytes()) if array.size else b""


def _unpacked(data: bytes, n_bytes: int, where: str) -> bytes:
    if not n_bytes and not data:
        return b""
    stream = zlib.decompressobj()
    try:
        found = stream.decompress(data, n_bytes + 1)
    except zlib.error as error:
        raise FormatError(f"{where}: expected packed symbols, got something else: {error}") from error
    if len(found) != n_bytes or not stream.eof or stream.unused_data:
        raise FormatError(f"{where}: expected {n_bytes} bytes, got another number")
    return found


def encode_structure(bricks: Bricks, coarser: Bricks | None) -> bytes:
    return _packed(bricks.coords.astype("<u2").view("u1")) and zlib.compress(
        bricks.coords.astype("<u2").tobytes() + bricks.masks.astype("<u8").tobytes()
    )


def decode_structure(data: bytes, n_bricks: int, coarser: Bricks | None, n_cells: int, where: str) -> Bricks:
    found = _unpacked(data, 70 * n_bricks, where)
    coords = np.frombuffer(found, "<u2", 3 * n_bricks).reshape(-1, 3)
    masks = np.frombuffer(found[6 * n_bricks :], "<u8", 8 * n_bricks).reshape(-1, 8)
    return Bricks(coords, masks)
