"""Encode and decode a channel's symbols in compiled code, lane by lane. `player.asset.coder.arrays` has the
same functions in numpy."""

from __future__ import annotations

import numpy as np

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
from player.compiling import compiled
from player.scratch import check_scratch, scratch


def encode_channel(states: np.ndarray, counts: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Encode the symbols of a channel, as `player.asset.coder.arrays.encode_channel` does."""
    words = scratch(len(counts), np.uint16)  # a symbol takes one word or none
    at = _encode(states, counts, first, words)
    check_scratch(words)
    return words[at:].copy()


@compiled
def _encode(states, counts, first, words):
    n, n_lanes = len(counts), len(states)
    bits, word, full = np.uint32(BITS), np.uint32(16), np.uint32(32 - BITS)
    at = n
    begin = (n - 1) // n_lanes * n_lanes
    while begin >= 0:
        for lane in range(min(n_lanes, n - begin) - 1, -1, -1):  # words are written from last to first
            x, count = states[lane], counts[begin + lane]
            if x >> full >= count:
                at -= 1
                words[at] = np.uint16(x & np.uint32(0xFFFF))
                x = np.uint32(x >> word)
            times = np.uint32(x // count)
            states[lane] = np.uint32((times << bits) + (x - times * count) + first[begin + lane])
        begin -= n_lanes
    return at


def decode_channel(
    words: np.ndarray,
    at: int,
    states: np.ndarray,
    lookup: DecoderTables,
    of_context: np.ndarray,
    classes: np.ndarray,
    neighbours: np.ndarray,
) -> tuple[np.ndarray, int]:
    """Decode the symbols of a channel, as `player.asset.coder.arrays.decode_channel` does."""
    n = len(classes)
    near, of_lane = scratch(n + 1, np.uint8, END), scratch(len(states), np.uint8)
    table_of_sum = of_context[:, CONTEXT_OF_SUM].reshape(-1)
    at = _decode(words, at, states, lookup, table_of_sum, classes, neighbours, MIXED, near, of_lane)
    check_scratch(near, of_lane)
    return np.subtract(near[:n], END, dtype=np.int16), at


@compiled
def _decode(words, at, states, lookup, table_of_sum, classes, neighbours, mixed, near, of_lane):
    n, n_lanes = len(classes), len(states)
    n_words, n_steps, n_longer = len(words) - n_lanes, n // n_lanes, n % n_lanes
    symbol_of, places = lookup
    along_z, along_y, along_x = neighbours[0], neighbours[1], neighbours[2]
    bits, word, low_half = np.uint32(BITS), np.uint32(16), np.uint32(0xFFFF)
    begin = 0
    for step in range(n_steps + 1):
        n_active = n_lanes if step < n_steps else n_longer
        for lane in range(n_active):  # a loop of its own, independent of the states: the loads overlap
            i = np.uint64(begin + lane)
            total = mixed[near[along_z[i]]] + mixed[near[along_y[i]]] + mixed[near[along_x[i]]] + HALF
            of_lane[lane] = table_of_sum[np.uint32(classes[i] * N_MIXED + total)]
        for lane in range(n_active):
            table, x = np.uint32(of_lane[lane]), states[lane]
            place = x & np.uint32(TOTAL - 1)
            symbol = np.uint32(symbol_of[(table << bits) | place])
            entry = places[(table << np.uint32(SYMBOL_BITS)) | symbol]
            x = np.uint32(np.uint32(entry >> word) * np.uint32(x >> bits))
            x = np.uint32(x + place - (entry & low_half))
            is_low = x < np.uint32(1 << 16)
            more = np.uint32((x << word) | words[np.uint64(at)])
            states[lane] = more if is_low else x
            at += is_low
            of_lane[lane] = symbol
        row = np.uint64(step)
        for lane in range(n_active):  # after the loops above: symbols of the same step count as unknown
            near[row] = of_lane[lane]
            row += np.uint64(n_steps + (lane < n_longer))
        begin += n_lanes
        if at > n_words:
            return -1
    return at
