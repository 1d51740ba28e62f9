"""An entropy coder for small integers: interleaved rANS, decoded in many lanes that advance together.

A *block* has n rows and some channels. Its symbols are coded channel by channel, and within a channel in
the order of `player.asset.coder.lanes`. Each lane has a 32-bit state x, at least 2^16, which it keeps from
one channel to the next. The symbol's context chooses a table (`player.asset.coder.tables`), in which each
symbol has `count` of the 4096 places, beginning with the place `first`. A lane decodes a symbol so:

    place = x & 4095; the symbol is the one that has this place
    x = count (x >> 12) + place - first
    if x < 2^16: x = x 2^16 + the next 16-bit word

All lanes take words from one stream: in each step, the lanes that need a word take one in the order of lanes.
At the end each state is 2^16 again and all words are taken. The decoder checks this, which detects nearly all
damage.

A block's bytes, all numbers little-endian:

    uint32 n_lanes, 1 to 4096 and at most n; uint32 n_packed; uint32 n_words
    n_packed bytes: the tables
    uint32 [n_lanes]: the states with which decoding begins, each at least 2^16
    uint16 [n_words]: the words
    uint8 [...]: for each symbol -63 or 63, by channel and row, how much further from 0 it is, 0 to 192

A block of no rows or no channels has no bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from types import ModuleType

import numpy as np

from player.asset.coder.lanes import Neighbours, RowsToLanes
from player.asset.coder.tables import (
    CONTEXT_OF_SUM,
    END,
    HALF,
    MIXED,
    N_CONTEXTS,
    N_SYMBOLS,
    Tables,
    fit_tables,
    unpack_tables,
)
from player.errors import FormatError, ShapeError

MAX_LANES = 4096
MAX_SYMBOL = 255
LOW = 1 << 16
"""The lowest state, with which encoding begins."""

_HEADER = struct.Struct("<III")
_MOST_CODED = 1024
"""The most lanes that the encoder uses: each costs two bytes, and twice as many are hardly faster."""
_LANE_BITS = 2048
"""The encoder uses fewer lanes where each would code fewer bits than this."""


def encode(
    symbols: np.ndarray, neighbours: Neighbours, classes: Sequence[np.ndarray], n_classes: int
) -> bytes:
    """Encode symbols as the bytes of a block.

    Args:
        symbols: [n, n_channels] integers, -255 to 255; the more of them are 0, the fewer bytes they take.
        neighbours: the neighbours of the n rows.
        classes: for each channel [n] uint8, below `n_classes`: a class of each symbol that the decoder knows
            beforehand. Symbols of different classes are counted separately.
        n_classes: number of classes, 1 or more.

    Raises:
        ShapeError: shapes do not agree, or a symbol or a class is out of its range.

    >>> rows = Neighbours(np.stack([np.arange(1000, dtype=np.int32) - n for n in (1, 2, 3)]))
    >>> symbols = (np.arange(2000).reshape(1000, 2) % 50 == 0).astype(np.int16)
    >>> classes = [np.zeros(1000, np.uint8)] * 2
    >>> data = encode(symbols, rows, classes, 1)
    >>> len(data) < 200, np.array_equal(decode(data, rows, classes, 1, "here"), symbols)
    (True, True)
    """
    n, n_channels = _check(symbols, neighbours, classes, n_classes)
    if not symbols.size:
        return b""
    rows = np.clip(symbols.T, -END, END).astype(np.int8)
    lanes = RowsToLanes(n, min(max(n >> 8, 1), _MOST_CODED))
    found, n_bits = _fit(rows, neighbours.known(lanes), classes, n_classes)
    fewer = max(min(lanes.n_lanes, int(n_bits) // _LANE_BITS), n >> 12, 1)
    if fewer < lanes.n_lanes:
        lanes = RowsToLanes(n, fewer)
        found, _ = _fit(rows, neighbours.known(lanes), classes, n_classes)
    known = neighbours.known(lanes)
    states, words = np.full(lanes.n_lanes, LOW, np.uint32), []
    counts = found.counts.astype(np.uint32)
    first = (np.cumsum(counts, axis=1) - counts).astype(np.uint32).reshape(-1)
    for channel in reversed(range(n_channels)):
        context = _contexts(rows[channel], known, classes[channel])
        named = found.of_context[channel].reshape(-1).take(context)
        index = lanes.in_order(named.astype(np.int32) * N_SYMBOLS + rows[channel] + END)
        words.append(_twin().encode_channel(states, counts.reshape(-1).take(index), first.take(index)))
    stream = np.concatenate(words[::-1])
    sizes = np.abs(symbols.T.astype(np.int16))
    beyond = sizes[sizes >= END] - END
    packed = found.packed()
    parts = (states.astype("<u4"), stream.astype("<u2"), beyond.astype(np.uint8))
    header = _HEADER.pack(lanes.n_lanes, len(packed), len(stream))
    return header + packed + b"".join(part.tobytes() for part in parts)


def _check(
    symbols: np.ndarray, neighbours: Neighbours, classes: Sequence[np.ndarray], n_classes: int
) -> tuple[int, int]:
    n = neighbours.n
    if symbols.ndim != 2 or len(symbols) != n or len(classes) != symbols.shape[1]:
        raise ShapeError(
            f"coder: symbols: expected [{n}, {len(classes)}] as neighbours and classes have it, "
            f"got {list(symbols.shape)}"
        )
    if symbols.size and max(int(symbols.max()), -int(symbols.min())) > MAX_SYMBOL:
        raise ShapeError(f"coder: symbols: expected magnitudes up to {MAX_SYMBOL}, got more")
    if any(each.shape != (n,) or each.max(initial=0) >= n_classes for each in classes):
        raise ShapeError(f"coder: classes: expected [{n}] numbers below {n_classes}")
    return symbols.shape


def _contexts(row: np.ndarray, known: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Return the context [n] int64 of each symbol of a channel [n], numbered class after class."""
    near = np.append(MIXED.take(row + np.int16(END)), np.int16(0))
    sums = near.take(known[0])  # takes half the time of near[known[0]]
    for rows in known[1:]:
        sums += near.take(rows)
    return CONTEXT_OF_SUM.take(sums + HALF) + classes.astype(np.int64) * N_CONTEXTS


def _fit(
    rows: np.ndarray, known: np.ndarray, classes: Sequence[np.ndarray], n_classes: int
) -> tuple[Tables, float]:
    """Return tables fitted to clipped symbols [n_channels, n], and the bits that the symbols then take."""
    n_contexts = n_classes * N_CONTEXTS
    filled, seen = [], []
    for channel, row in enumerate(rows):
        context = _contexts(row, known, classes[channel])
        occurring = np.bincount(context, minlength=n_contexts) > 0
        number = np.cumsum(occurring) - 1
        filled.append(np.flatnonzero(occurring) + channel * n_contexts)
        n_seen = np.bincount(
            number.take(context) * N_SYMBOLS + row + END, minlength=len(filled[-1]) * N_SYMBOLS
        )
        seen.append(n_seen.reshape(-1, N_SYMBOLS))
    return fit_tables(np.concatenate(seen), np.concatenate(filled), (len(rows), n_classes))


class Decoder:
    """A decoder that returns a block channel by channel, so that classes may depend on earlier channels.

    >>> rows = Neighbours(np.full((3, 4), -1, np.int32))
    >>> none = np.zeros(4, np.uint8)
    >>> data = encode(np.array([[3, 0], [-200, 0], [0, 0], [0, 1]]), rows, [none, none], 1)
    >>> decoder = Decoder(data, rows, 2, 1, "here")
    >>> decoder.channel(none).tolist(), decoder.channel(none).tolist()
    ([3, -200, 0, 0], [0, 0, 0, 1])
    >>> decoder.finish()
    """

    def __init__(
        self, data: bytes, neighbours: Neighbours, n_channels: int, n_classes: int, where: str
    ) -> None:
        """Read the header, tables, states and words of a block.

        Args:
            data: a block's bytes.
            neighbours: the neighbours of the n rows.
            n_channels, n_classes: those that the block was encoded with.
            where: the block's name in error messages.

        Raises:
            FormatError: not a block of so many rows and channels. Memory is bounded by the number of rows and
                the length of `data`, plus 2 MB.
        """
        self._where = where
        self._channel, self._n_channels = 0, n_channels
        self._by_row, self._classes = None, np.zeros(0, np.uint8)
        self._at = self._n_beyond = 0
        self._n = n = neighbours.n
        self._empty = not n * n_channels
        if self._empty:
            if data:
                raise FormatError(f"{where}: expected no bytes for no symbols, got {len(data)}")
            return
        if len(data) < _HEADER.size:
            raise FormatError(f"{where}: expected a header of {_HEADER.size} bytes, got {len(data)}")
        n_lanes, n_packed, n_words = _HEADER.unpack_from(data)
        if not 1 <= n_lanes <= min(MAX_LANES, n):
            raise FormatError(f"{where}: lanes: expected 1 to {min(MAX_LANES, n)}, got {n_lanes}")
        begin = _HEADER.size + n_packed
        end = begin + 4 * n_lanes + 2 * n_words
        if len(data) < end:
            raise FormatError(f"{where}: expected at least {end} bytes, got {len(data)}")
        tables = unpack_tables(data[_HEADER.size : begin], n_channels, n_classes, where)
        self._lookup, self._of_context = tables.lookup(), tables.of_context
        self._has_ends = bool(tables.counts[:, [0, -1]].any())
        self._states = np.frombuffer(data, "<u4", n_lanes, begin).astype(np.uint32)
        if (self._states < LOW).any():
            raise FormatError(f"{where}: states: expected {LOW} or more, got {self._states.min()}")
        self._n_words = n_words
        self._words = np.zeros(n_words + n_lanes, np.uint32)
        self._words[:n_words] = np.frombuffer(data, "<u2", n_words, begin + 4 * n_lanes)
        self._beyond = np.frombuffer(data, np.uint8, offset=end)
        if (self._beyond > MAX_SYMBOL - END).any():
            raise FormatError(f"{where}: symbols: expected magnitudes up to {MAX_SYMBOL}, got more")
        self._lanes = RowsToLanes(n, n_lanes)
        self._near = neighbours.in_order(self._lanes)

    def channel(self, classes: np.ndarray) -> np.ndarray:
        """Decode the symbols [n] int16 of the next channel with classes [n] uint8. Raises FormatError."""
        if self._empty:
            return np.zeros(self._n, np.int16)
        if classes is not self._by_row:
            self._by_row, self._classes = classes, self._lanes.in_order(classes)
        found, self._at = _twin().decode_channel(
            self._words,
            self._at,
            self._states,
            self._lookup,
            self._of_context[self._channel],
            self._classes,
            self._near,
        )
        if self._at < 0:
            raise FormatError(f"{self._where}: words: expected more than {self._n_words}")
        self._channel += 1
        if self._has_ends:
            ends = np.flatnonzero(np.abs(found) == END)
            beyond = self._beyond[self._n_beyond : self._n_beyond + len(ends)]
            self._n_beyond += len(ends)
            if len(beyond) < len(ends):
                raise FormatError(
                    f"{self._where}: symbols beyond {END}: expected more than {len(self._beyond)}"
                )
            found[ends] += np.sign(found[ends]) * beyond.astype(np.int16)
        return found

    def finish(self) -> None:
        """Raise FormatError unless everything has been read, and every state is what encoding began with."""
        if self._empty:
            return
        if self._channel != self._n_channels or self._at != self._n_words:
            raise FormatError(f"{self._where}: words: expected {self._at}, got {self._n_words}")
        if self._n_beyond != len(self._beyond):
            raise FormatError(
                f"{self._where}: symbols beyond {END}: expected {self._n_beyond}, got {len(self._beyond)}"
            )
        if (self._states != LOW).any():
            raise FormatError(f"{self._where}: damaged: expected every state to end at {LOW}")


def decode(
    data: bytes, neighbours: Neighbours, classes: Sequence[np.ndarray], n_classes: int, where: str
) -> np.ndarray:
    """Undo `encode`.

    Args:
        data: a block's bytes.
        neighbours, classes, n_classes: as for `encode`.
        where: the block's name in error messages.

    Returns:
        [n, n_channels] int16, contiguous channel by channel.

    Raises:
        FormatError: not a block of so many rows and channels. Memory is bounded by the numbers of rows and
            channels and the length of `data`, time by these numbers.
    """
    decoder = Decoder(data, neighbours, len(classes), n_classes, where)
    found = np.empty((len(classes), neighbours.n), np.int16)
    for channel, of_channel in zip(found, classes, strict=True):
        channel[:] = decoder.channel(of_channel)
    decoder.finish()
    return found.T


def _twin() -> ModuleType:
    """Return the module that codes a channel: compiled code where numba is available, otherwise numpy."""
    from player import compiling

    if compiling.available():
        from player.asset.coder import compiled

        return compiled
    from player.asset.coder import arrays

    return arrays
