"""Tables of probabilities, in 4096ths, of the symbols in each context; contexts can share a table.

A symbol is an integer from -63 to 63; the two ends stand for anything beyond as well. The context of a symbol
is given by its neighbours' symbols (`CONTEXT_OF_SUM`), by a class that is known beforehand, and by the
channel. A block has up to 64 tables, and every context names one of them.
"""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from player.errors import FormatError

END = 63
"""The largest magnitude of a symbol in a table; it stands for larger ones, too."""
N_SYMBOLS = 2 * END + 1
BITS = 12
"""Bits of a probability: probabilities are whole 4096ths."""
TOTAL = 1 << BITS
MAX_TABLES = 64
SYMBOL_BITS = 7

NEAR = 15
"""Neighbours' symbols are clipped to -15 ... 15."""
SUM_STEPS = (1, 2, 3, 5, 8, 12, 18, 30)
"""Thresholds of the sum of the neighbours' magnitudes; the context changes at each."""
LEAN_STEPS = (1, 2, 4, 8)
"""Thresholds of the magnitude of the sum of the neighbours' symbols; the context changes at each."""
N_CONTEXTS = (len(SUM_STEPS) + 1) * (2 * len(LEAN_STEPS) + 1)

N_MIXED = (3 * NEAR + 1) << 7
"""Length of tables indexed by the sum of three numbers of MIXED and HALF, which is always below it."""
HALF = 64
"""Added to sums of MIXED, so that the bits from 7 on are the sum of the magnitudes."""

TABLE_BITS = 48.0
"""Bits that the encoder assumes another table costs, besides a byte for each symbol in it."""


_CLIPPED = np.clip(np.arange(-END, END + 1), -NEAR, NEAR).astype(np.int16)
MIXED = (np.abs(_CLIPPED) << 7) + _CLIPPED
"""[127] int16: `128 |s| + s` of each symbol s, clipped to -15 ... 15, at the index symbol + 63: one sum adds
symbols and magnitudes."""


def _contexts_of_sums() -> np.ndarray:
    sums = np.arange(N_MIXED) - HALF
    total = (sums + HALF) >> 7
    lean = sums - (total << 7)
    side = np.sign(lean) * np.searchsorted(LEAN_STEPS, np.abs(lean), side="right")
    rise = np.searchsorted(SUM_STEPS, total, side="right")
    return (rise * (2 * len(LEAN_STEPS) + 1) + side + len(LEAN_STEPS)).astype(np.uint8)


CONTEXT_OF_SUM = _contexts_of_sums()
"""[N_MIXED] uint8: the context, at the index that is 64 plus the sum of MIXED of the three neighbours'
symbols, which are 0 where not known.

With these symbols s, clipped, let M be the sum of |s| and L the sum of s. The context is 9 a + 4 + b. Here a
is how many of `SUM_STEPS` are at most M; the magnitude of b is how many of `LEAN_STEPS` are at most |L|, and
its sign is that of L."""


class DecoderTables(NamedTuple):
    """Tables in the form that a decoder reads."""

    symbols: np.ndarray
    """[n_tables * 4096] uint8: the symbol + 63 that has each place."""
    places: np.ndarray
    """[n_tables * 128] uint32: for each symbol + 63, its count * 2^16 + the first of its places."""


class Tables(NamedTuple):
    """The tables of a block."""

    counts: np.ndarray
    """[n_tables, 127] uint16: the 4096ths of the symbols -63 ... 63 in each table; rows add up to 4096."""
    of_context: np.ndarray
    """[n_channels, n_classes, 81] uint8: the table of each context."""

    def lookup(self) -> DecoderTables:
        """Return the tables in the form that a decoder reads."""
        first = np.cumsum(self.counts, axis=1, dtype=np.uint32) - self.counts
        places = np.zeros((len(self.counts), 1 << SYMBOL_BITS), np.uint32)
        places[:, :N_SYMBOLS] = (self.counts.astype(np.uint32) << 16) | first
        symbols = np.tile(np.arange(N_SYMBOLS, dtype=np.uint8), len(self.counts))
        return DecoderTables(symbols.repeat(self.counts.reshape(-1)), places.reshape(-1))

    def packed(self) -> bytes:
        """Return the tables as bytes: a zlib stream of the table index of each context, the number of tables,
        the first symbol + 63 and the number of symbols of each, and the symbols' counts, 16 bits each."""
        used = self.counts > 0
        first, beyond = used.argmax(axis=1), N_SYMBOLS - used[:, ::-1].argmax(axis=1)
        symbol = np.arange(N_SYMBOLS)
        inside = (symbol >= first[:, None]) & (symbol < beyond[:, None])
        ranges = np.stack([first, beyond - first], axis=-1).astype(np.uint8)
        parts = (self.of_context.tobytes(), bytes([len(self.counts)]), ranges.tobytes())
        return zlib.compress(b"".join(parts) + self.counts[inside].astype("<u2").tobytes(), 9)


def unpack_tables(data: bytes, n_channels: int, n_classes: int, where: str) -> Tables:
    """Undo `Tables.packed`. Raises FormatError; unpacks no more than 20 kB and a byte a context."""
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


def fit_tables(seen: np.ndarray, filled: np.ndarray, shape: tuple[int, int]) -> tuple[Tables, float]:
    """Return tables fitted to how often each symbol occurs in each context, and the bits of all symbols then.

    Contexts that are alike share a table. Tables are added one by one, each from the counts of the context
    that the tables so far serve worst. Then, in turns, each context chooses its cheapest table and each table
    becomes the sum of its contexts.

    Args:
        seen: [n_filled, 127] how often each symbol occurs in each context that occurs.
        filled: [n_filled] indices of these contexts among all n_channels * n_classes * 81, in order.
        shape: (n_channels, n_classes).
    """
    used = seen.astype(np.float64)
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
    last = np.searchsorted(filled, np.arange(shape[0] * shape[1] * N_CONTEXTS), side="right") - 1
    of_context = chosen.reshape(-1)[np.maximum(last, 0)]  # a context without symbols: as the one before
    found = Tables(counts[kept], of_context.astype(np.uint8).reshape(*shape, N_CONTEXTS))
    return found, float(cost.min(axis=1).sum())


def _bits(tables: np.ndarray) -> np.ndarray:
    """Return the bits [n, 127] of each symbol, by how often it occurs in each table [n, 127]. A symbol that a
    table lacks costs many bits, but finitely many."""
    share = tables + 0.01
    return np.log2(share.sum(axis=1, keepdims=True)) - np.log2(share)


def _counts(tables: np.ndarray) -> np.ndarray:
    """Return how often symbols occur as whole 4096ths, [n, 127] uint16, at least 1 for each that occurs."""
    wanted = tables * (TOTAL / tables.sum(axis=1, keepdims=True))
    counts = np.where(tables > 0, np.maximum(np.rint(wanted), 1), 0).astype(np.int64)
    for row, ideal in zip(counts, wanted, strict=True):
        while (over := int(row.sum()) - TOTAL) != 0:
            sign = 1 if over > 0 else -1
            ratio = np.where(row > (sign > 0), (row - ideal) * sign / np.maximum(row, 1), -np.inf)
            at = np.argsort(-np.where(row > 0, ratio, -np.inf), kind="stable")[: min(abs(over), 16)]
            row[at[row[at] > (sign > 0)]] -= sign
    return counts.astype(np.uint16)
