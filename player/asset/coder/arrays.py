"""Encode and decode a channel's symbols in numpy, all lanes at a time. `player.asset.coder.compiled` has the
same functions as compiled code."""

from __future__ import annotations

import numpy as np

from player.asset.coder.lanes import RowsToLanes
from player.asset.coder.tables import (
    BITS,
    CONTEXT_OF_SUM,
    END,
    HALF,
    MIXED,
    N_MIXED,
    SYMBOL_BITS,
    TOTAL,
    DecoderTables,
)

_PLACE, _COUNT, _FIRST = np.uint32(TOTAL - 1), np.uint32(BITS), np.uint32(0xFFFF)
_LOW, _WORD = np.uint32(1 << 16), np.uint32(16)


def encode_channel(states: np.ndarray, counts: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Encode the symbols of a channel, the last one first.

    Args:
        states: [n_lanes] uint32, changed in place.
        counts: [n] uint32: number of places of each symbol in its table, in the order of coding.
        first: [n] uint32: the first place of each symbol.

    Returns:
        [n_words] uint16 words, in the order in which the decoder reads them.
    """
    n_lanes, words = len(states), []
    for begin in reversed(range(0, len(counts), n_lanes)):
        count, start = counts[begin : begin + n_lanes], first[begin : begin + n_lanes]
        x = states[: len(count)]
        full = (x >> np.uint32(32 - BITS)) >= count
        words.append(x[full].astype(np.uint16))
        x = np.where(full, x >> _WORD, x)
        times = x // count
        states[: len(count)] = (times << _COUNT) + (x - times * count) + start
    return np.concatenate(words[::-1])


def decode_channel(
    words: np.ndarray,
    at: int,
    states: np.ndarray,
    lookup: DecoderTables,
    of_context: np.ndarray,
    classes: np.ndarray,
    neighbours: np.ndarray,
) -> tuple[np.ndarray, int]:
    """Decode the symbols of a channel.

    Args:
        words: [n_words + n_lanes] uint32, below 2^16; the entries behind the last word may be anything.
        at: number of words that have been taken before.
        states: [n_lanes] uint32, changed in place.
        lookup: the tables.
        of_context: [n_classes, 81] uint8: the table of each context.
        classes: [n] uint8 in the order of coding.
        neighbours: [3, n] uint32 rows, in the order of coding; n for a neighbour that does not exist.

    Returns:
        [n] int16 symbols by row; and the number of words taken now, or -1 if there are too few.
    """
    n, n_lanes = len(classes), len(states)
    n_words, lanes = len(words) - n_lanes, RowsToLanes(n, n_lanes)
    table_of_sum = of_context[:, CONTEXT_OF_SUM].reshape(-1)
    row = np.concatenate([runs[:, 0] for runs in lanes.runs(np.arange(n))])  # the first of each run
    found, near = np.empty(n, np.uint8), np.zeros(n + 1, np.int16)
    along_z, along_y, along_x = neighbours
    for begin in range(0, n, n_lanes):
        step = slice(begin, min(begin + n_lanes, n))
        x = states[: step.stop - begin]
        sums = near[along_z[step]]
        sums += near[along_y[step]]
        sums += near[along_x[step]]
        table = table_of_sum[classes[step] * np.intp(N_MIXED) + (sums + HALF)].astype(np.intp)
        place = x & _PLACE
        symbol = lookup.symbols[(table << BITS) + place]
        entry = lookup.places[(table << SYMBOL_BITS) + symbol]
        found[step] = symbol
        near[row[: len(x)]] = MIXED[symbol]
        row += 1
        x >>= _COUNT
        x *= entry >> _WORD
        x += place
        x -= entry & _FIRST
        (low,) = (x < _LOW).nonzero()
        taken = words[at : at + len(low)]
        at += len(low)
        if at > n_words:
            return np.empty(0, np.int16), -1
        x[low] = (x[low] << _WORD) | taken
    return lanes.by_row(found).astype(np.int16) - np.int16(END), at
