"""Encodes and decodes a channel's symbols in numpy, all lanes at a time. `player.asset.coder.compiled` is its
twin."""

from __future__ import annotations

import numpy as np

from player.asset.coder.lanes import Lanes
from player.asset.coder.tables import (
    BITS,
    CONTEXT_OF_SUM,
    END,
    HALF,
    MIXED,
    N_MIXED,
    SYMBOL_BITS,
    TOTAL,
    Lookup,
)

_PLACE, _COUNT, _FIRST = np.uint32(TOTAL - 1), np.uint32(BITS), np.uint32(0xFFFF)
_LOW, _WORD = np.uint32(1 << 16), np.uint32(16)


def encode_channel(states: np.ndarray, counts: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Encode the symbols of a channel, the last one first.

    Args:
        states: [n_lanes] uint32, changed.
        counts: [n] uint32 places of the symbol at each position, in the order of coding.
        first: [n] uint32 where they begin.

    Returns:
        [n_words] uint16 in the order in which they are read.
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
    lookup: Lookup,
    of_context: np.ndarray,
    classes: np.ndarray,
    neighbours: np.ndarray,
) -> tuple[np.ndarray, int]:
    """The symbols of a channel.

    Args:
        words: [n_words + n_lanes] uint32, below 2^16; behind the last word there may be anything.
        at: how many of them are taken.
        states: [n_lanes] uint32, changed.
        lookup: the tables.
        of_context: [n_classes, 81] uint8: the table of each context.
        classes: [n] uint8 in the order of coding.
        neighbours: [3, n] uint32 rows, in the order of coding; n for one that is not there.

    Returns:
        [n] int16 symbols by row; how many words are taken now, or -1 if there are too few.
    """
    n, n_lanes = len(classes), len(states)
    n_words, lanes = len(words) - n_lanes, Lanes(n, n_lanes)
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
