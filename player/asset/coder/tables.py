"""Tables of probabilities: how often each symbol comes in a context, in 4096ths, and which context has which.

A symbol is an integer from -63 to 63; the two ends stand for anything beyond as well. The context of a symbol
is the `context` of its neighbours' symbols, and a class that is known beforehand; each channel has contexts
of its own. A block has up to 64 tables, and every context names one of them.
"""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from player.errors import FormatError

END = 63
"""The largest magnitude that has a place of its own in a table."""
N_SYMBOLS = 2 * END + 1
BITS = 12
"""Probabilities are whole 4096ths."""
TOTAL = 1 << BITS
MAX_TABLES = 64
SYMBOL_BITS = 7

NEAR = 15
"""Neighbours' symbols count as -15 to 15."""
SUM_STEPS = (1, 2, 3, 5, 8, 12, 18, 30)
"""Sums of magnitudes from which on the context is another one."""
LEAN_STEPS = (1, 2, 4, 8)
"""Magnitudes of the sum of the symbols from which on the context is another one."""
N_CONTEXTS = (len(SUM_STEPS) + 1) * (2 * len(LEAN_STEPS) + 1)

N_MIXED = (3 * NEAR + 1) << 7
"""Numbers that `mixed` symbols and 64 add up to."""
HALF = 64

TABLE_BITS = 48.0
"""What the encoder takes another table to cost, beside a byte for each symbol in it."""


def context(symbols: np.ndarray) -> np.ndarray:
    """The context [n] that follows from the symbols [3, n] of the neighbours, 0 where one is not known.

    With the sums M of |s| and L of s, each s clipped to -15 ... 15: how many of `SUM_STEPS` are at most M,
    times 9, plus 4, plus with the sign of L how many of `LEAN_STEPS` are at most |L|.

    >>> context(np.array([[0, 1, 9, -63], [0, 0, 9, -1], [0, 0, -1, 1]])).tolist()
    [4, 14, 71, 54]
    """
    near = np.clip(symbols, -NEAR, NEAR).astype(np.int64)
    total, lean = np.abs(near).sum(axis=0), near.sum(axis=0)
    side = np.sign(lean) * np.searchsorted(LEAN_STEPS, np.abs(lean), side="right")
    return (
        np.searchsorted(SUM_STEPS, total, side="right") * (2 * len(LEAN_STEPS) + 1) + side + len(LEAN_STEPS)
    )


def mixed(symbols: np.ndarray) -> np.ndarray:
    """Magnitude and sign of clipped symbols in one int16, `128 |s| + s`, so that one sum adds up both."""
    near = np.clip(symbols, -NEAR, NEAR).astype(np.int16)
    return (np.abs(near) << 7) + near


MIXED = mixed(np.arange(-END, END + 1))
"""[127] int16: `mixed`, by the symbol + 63."""


def _contexts_of_sums() -> np.ndarray:
    sums = np.arange(N_MIXED) - HALF
    total = (sums + HALF) >> 7
    lean = sums - (total << 7)
    side = np.sign(lean) * np.searchsorted(LEAN_STEPS, np.abs(lean), side="right")
    rise = np.searchsorted(SUM_STEPS, total, side="right")
    return (rise * (2 * len(LEAN_STEPS) + 1) + side + len(LEAN_STEPS)).astype(np.uint8)


CONTEXT_OF_SUM = _contexts_of_sums()
"""[N_MIXED] uint8: `context` by the sum of the three neighbours' `mixed` symbols and 64."""


class Lookup(NamedTuple):
    """Tables as a decoder reads them."""

    symbols: np.ndarray
    """[n_tables * 4096] uint8: the symbol + 63 at each place."""
    places: np.ndarray
    """[n_tables * 128] uint32: for each symbol + 63 its count, times 2^16, and where its places begin."""


class Tables(NamedTuple):
    """The tables of a block."""

    counts: np.ndarray
    """[n_tables, 127] uint16: the 4096ths of the symbols -63 ... 63 in each table; rows add up to 4096."""
    of_context: np.ndarray
    """[n_channels, n_classes, 81] uint8: the table of each context."""

    def lookup(self) -> Lookup:
        """The tables as a decoder reads them."""
        first = np.cumsum(self.counts, axis=1, dtype=np.uint32) - self.counts
        places = np.zeros((len(self.counts), 1 << SYMBOL_BITS), np.uint32)
        places[:, :N_SYMBOLS] = (self.counts.astype(np.uint32) << 16) | first
        symbols = np.tile(np.arange(N_SYMBOLS, dtype=np.uint8), len(self.counts))
        return Lookup(symbols.repeat(self.counts.reshape(-1)), places.reshape(-1))

    def packed(self) -> bytes:
        """The tables as bytes: zlib of the tables' indices by context, the number of tables, the first symbol
        + 63 and the number of symbols of each, and their counts, 16 bits each."""
        used = self.counts > 0
        first, beyond = used.argmax(axis=1), N_SYMBOLS - used[:, ::-1].argmax(axis=1)
        symbol = np.arange(N_SYMBOLS)
        inside = (symbol >= first[:, None]) & (symbol < beyond[:, None])
        ranges = np.stack([first, beyond - first], axis=-1).astype(np.uint8)
        parts = (self.of_context.tobytes(), bytes([len(self.counts)]), ranges.tobytes())
        return zlib.compress(b"".join(parts) + self.counts[inside].astype("<u2").tobytes(), 9)


def unpack_tables(data: bytes, n_channels: int, n_classes: int, where: str) -> Tables:
    """Undo `Tables.packed`. Raises FormatError; takes no more than 20 kB and a byte a context."""
    n_named = n_channels * n_classes * N_CONTEXTS
    most = n_named + 1 + MAX_TABLES * (2 + 2 * N_SYMBOLS)
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(data, most + 1)
    except zlib.error as error:
        raise FormatError(f"{where}: tables: expected a zlib stream, got something else: {error}") from error
    if not stream.eof or stream.unused_data or len(content) <= n_named:
        raise FormatError(f"{where}: tables: expected one whole zlib stream of {n_named} contexts and tables")
    n_tables = content[n_named]
    begin = n_named + 1 + 2 * n_tables
    ranges = np.frombuffer(content[n_named + 1 : begin], np.uint8).astype(np.int64)
    named = np.frombuffer(content, np.uint8, n_named)
    if not 1 <= n_tables <= MAX_TABLES or len(ranges) != 2 * n_tables or named.max(initial=0) >= n_tables:
        raise FormatError(f"{where}: tables: expected 1 to {MAX_TABLES}, and contexts that name one of them")
    first, n_symbols = ranges.reshape(-1, 2).T
    if (first + n_symbols > N_SYMBOLS).any() or len(content) != begin + 2 * n_symbols.sum():
        raise FormatError(f"{where}: tables: expected counts of symbols from -{END} to {END}, and no more")
    table = np.repeat(np.arange(n_tables), n_symbols)
    within = np.arange(len(table)) - np.repeat(np.cumsum(n_symbols) - n_symbols, n_symbols)
    counts = np.zeros((n_tables, N_SYMBOLS), np.uint16)
    counts[table, first[table] + within] = np.frombuffer(content, "<u2", len(table), begin)
    if (counts.sum(axis=1, dtype=np.int64) != TOTAL).any():
        raise FormatError(f"{where}: tables: expected counts that add up to {TOTAL}")
    return Tables(counts, named.reshape(n_channels, n_classes, N_CONTEXTS))


def fit_tables(seen: np.ndarray) -> tuple[Tables, float]:
    """Tables for how often each symbol comes in each context, and how many bits the symbols then take.

    Contexts that are alike share a table. One table after the other is begun with the context that the
    tables so far serve worst, then contexts choose tables and tables follow their contexts, in turns.

    Args:
        seen: [n_channels, n_classes, 81, 127] how often.
    """
    every = seen.reshape(-1, N_SYMBOLS).astype(np.float64)
    filled = np.flatnonzero(every.any(axis=1))
    used = every[filled]
    n_seen = used.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        own = -np.nansum(used * np.log2(used / n_seen[:, None]), axis=1)
    tables = used.sum(axis=0)[None]
    chosen = np.zeros(len(used), np.int64)
    cost = used @ _bits(tables).T
    for _ in range(MAX_TABLES - 1):
        worst = int(np.argmax(cost[:, 0] - own if cost.shape[1] == 1 else cost.min(axis=1) - own))
        if cost[worst].min() - own[worst] < TABLE_BITS + 8 * np.count_nonzero(used[worst]):
            break
        tables = np.concatenate([tables, used[worst][None]])
        cost = np.concatenate([cost, used @ _bits(used[worst][None]).T], axis=1)
    for _ in range(6):
        chosen = cost.argmin(axis=1)
        tables = np.zeros((cost.shape[1], N_SYMBOLS))
        np.add.at(tables, chosen, used)
        tables = tables[tables.any(axis=1)]
        cost = used @ _bits(tables).T
    counts = _counts(tables)
    with np.errstate(divide="ignore"):
        exact = BITS - np.log2(counts.astype(np.float64))
    exact[counts == 0] = 1e9
    cost = used @ exact.T
    chosen = cost.argmin(axis=1)
    kept, chosen = np.unique(chosen, return_inverse=True)
    of_context = np.zeros(len(every), np.uint8)
    last = np.searchsorted(filled, np.arange(len(every)), side="right") - 1
    of_context[:] = chosen.reshape(-1)[np.maximum(last, 0)]  # contexts without symbols: as the one before
    found = Tables(counts[kept], of_context.reshape(seen.shape[:-1]))
    return found, float(cost.min(axis=1).sum())


def _bits(tables: np.ndarray) -> np.ndarray:
    """Bits of each symbol by how often tables [n, 127] have it; rather many for one that they do not have."""
    share = tables + 0.01
    return np.log2(share.sum(axis=1, keepdims=True)) - np.log2(share)


def _counts(tables: np.ndarray) -> np.ndarray:
    """[n, 127] uint16 4096ths of how often symbols come, at least 1 for each that does."""
    wanted = tables * (TOTAL / tables.sum(axis=1, keepdims=True))
    counts = np.where(tables > 0, np.maximum(np.rint(wanted), 1), 0).astype(np.int64)
    for row, ideal in zip(counts, wanted, strict=True):
        while (over := int(row.sum()) - TOTAL) != 0:
            sign = 1 if over > 0 else -1
            ratio = np.where(row > (sign > 0), (row - ideal) * sign / np.maximum(row, 1), -np.inf)
            at = np.argsort(-np.where(row > 0, ratio, -np.inf), kind="stable")[: min(abs(over), 16)]
            row[at[row[at] > (sign > 0)]] -= sign
    return counts.astype(np.uint16)
