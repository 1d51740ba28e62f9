"""How rows of 8-bit codes are written in few bytes: one encoder, one decoder, shared by the bake and the
player.

Rows follow each other along z in a brick, so that neighbours in space are mostly neighbours in the file and
their codes lie close together. Each channel is written by itself, as the differences between successive rows
modulo 256, and the whole is a zlib stream (RFC 1950). Masks of bricks are such a stream as they are.
"""

from __future__ import annotations

import zlib

import numpy as np

from player.errors import FormatError

STRATEGIES = (zlib.Z_HUFFMAN_ONLY, zlib.Z_DEFAULT_STRATEGY)
"""The smaller is kept: differences of codes are noise, in which the repetitions that zlib finds cost more
than they save (lego: 11 % less without them), but for codes that hardly change."""


def pack_codes(codes: np.ndarray) -> bytes:
    """Codes [n] or [n, n_channels], int8 or uint8, as bytes.

    >>> codes = np.repeat(np.arange(200, dtype=np.uint8), 50)
    >>> packed = pack_codes(codes)
    >>> len(packed) < 300, np.array_equal(unpack_codes(packed, (10000,), "u1", "codes"), codes)
    (True, True)
    """
    planes = np.ascontiguousarray((codes if codes.ndim == 2 else codes[:, None]).T).view(np.uint8)
    steps = planes.copy()
    steps[:, 1:] -= planes[:, :-1]
    return min((_compressed(steps.tobytes(), strategy) for strategy in STRATEGIES), key=len)


def _compressed(data: bytes, strategy: int) -> bytes:
    stream = zlib.compressobj(strategy=strategy, memLevel=9)
    return stream.compress(data) + stream.flush()


def unpack_codes(data: bytes, shape: tuple[int, ...], dtype: str, where: str) -> np.ndarray:
    """Undo `pack_codes`.

    Args:
        data: the file's bytes.
        shape: [n] or [n, n_channels] that is expected.
        dtype: "i1" or "u1".
        where: the file's name in error messages.

    Raises:
        FormatError: not a zlib stream, or one of another length; never more than expected is unpacked.
    """
    n_codes = int(np.prod(shape, dtype=np.int64))
    steps = _decompressed(data, n_codes, "packed codes", where)
    n_channels = int(np.prod(shape[1:], dtype=np.int64))
    planes = np.frombuffer(steps, np.uint8).reshape(n_channels, shape[0])
    codes = np.empty((shape[0], n_channels), np.uint8)
    np.cumsum(planes.T, axis=0, dtype=np.uint8, out=codes)  # all channels at once: a third of the time
    return codes.view(dtype).reshape(shape)


def pack_masks(masks: np.ndarray) -> bytes:
    """Masks of bricks [n_bricks, 8] uint64 as bytes: neighbours resemble each other, which zlib finds.

    >>> masks = np.full((1000, 8), 2**64 - 1, np.uint64)
    >>> len(pack_masks(masks)) < 300, np.array_equal(unpack_masks(pack_masks(masks), 1000, "masks"), masks)
    (True, True)
    """
    return zlib.compress(np.ascontiguousarray(masks, "<u8").tobytes())


def unpack_masks(data: bytes, n_bricks: int, where: str) -> np.ndarray:
    """Undo `pack_masks`; `where` is the file's name in error messages. Raises FormatError."""
    return np.frombuffer(_decompressed(data, n_bricks * 64, "packed bytes", where), "<u8").reshape(-1, 8)


def _decompressed(data: bytes, n_bytes: int, what: str, where: str) -> bytes:
    """A zlib stream of exactly `n_bytes`; never more than that is unpacked."""
    stream = zlib.decompressobj()
    try:
        found = stream.decompress(data, n_bytes + 1)
    except zlib.error as error:
        raise FormatError(f"{where}: expected {what}, got something else: {error}") from error
    if len(found) != n_bytes or not stream.eof or stream.unused_data:
        got = f"{len(found)}" if len(found) < n_bytes else "more"
        raise FormatError(f"{where}: expected {n_bytes} {what}, got {got}")
    return found
