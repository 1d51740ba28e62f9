"""Unpack rows of 8-bit codes and masks of bricks from zlib streams (RFC 1950).

Rows follow each other along z in a brick, so that neighbours in space are mostly neighbours in the file and
their codes are similar. The channels of codes are stored one after another, each as the differences between
successive rows modulo 256. Masks of bricks are stored as they are, without differences.
"""

from __future__ import annotations

import zlib

import numpy as np

from player.errors import FormatError


def unpack_codes(data: bytes, shape: tuple[int, ...], dtype: str, where: str) -> np.ndarray:
    """Unpack codes from a zlib stream of differences.

    >>> unpack_codes(zlib.compress(bytes([7, 1, 255])), (3,), "u1", "codes").tolist()
    [7, 8, 7]

    Args:
        data: the file's bytes.
        shape: the expected shape, [n] or [n, n_channels].
        dtype: "i1" or "u1".
        where: the file's name in error messages.

    Raises:
        FormatError: not a zlib stream, or one of another length. Never more than expected is unpacked.
    """
    n_codes = int(np.prod(shape, dtype=np.int64))
    steps = _decompressed(data, n_codes, "packed codes", where)
    n_channels = int(np.prod(shape[1:], dtype=np.int64))
    planes = np.frombuffer(steps, np.uint8).reshape(n_channels, shape[0])
    codes = np.empty((shape[0], n_channels), np.uint8)
    np.cumsum(planes.T, axis=0, dtype=np.uint8, out=codes)  # all channels at once takes a third of the time
    return codes.view(dtype).reshape(shape)


def unpack_masks(data: bytes, n_bricks: int, where: str) -> np.ndarray:
    """Unpack masks [n_bricks, 8] uint64 of bricks; `where` is the file's name in error messages.

    Raises FormatError.
    """
    return np.frombuffer(_decompressed(data, n_bricks * 64, "packed bytes", where), "<u8").reshape(-1, 8)


def _decompressed(data: bytes, n_bytes: int, what: str, where: str) -> bytes:
    """Unpack a zlib stream of exactly `n_bytes`; at most one byte more is unpacked. Raises FormatError."""
    stream = zlib.decompressobj()
    try:
        found = stream.decompress(data, n_bytes + 1)
    except zlib.error as error:
        raise FormatError(f"{where}: expected {what}, got something else: {error}") from error
    if len(found) != n_bytes or not stream.eof or stream.unused_data:
        got = f"{len(found)}" if len(found) < n_bytes else "more"
        raise FormatError(f"{where}: expected {n_bytes} {what}, got {got}")
    return found
