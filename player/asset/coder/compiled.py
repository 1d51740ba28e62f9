"""Decodes a channel's symbols in compiled code, lane by lane. `player.asset.coder.arrays` is its twin."""

from __future__ import annotations

import numpy as np

from player.asset.coder.tables import BITS, CONTEXT_OF_SUM, END, HALF, MIXED, N_MIXED, TOTAL
from player.compiling import compiled
from player.scratch import check_scratch, scratch


def decode_channel(
    words: np.ndarray,
    at: int,
    states: np.ndarray,
    entries: np.ndarray,
    of_context: np.ndarray,
    classes: np.ndarray,
    neighbours: np.ndarray,
) -> tuple[np.ndarray, int, int]:
    """As `player.asset.coder.arrays.decode_channel`."""
    n, n_lanes = len(classes), len(states)
    found, near = scratch(n, np.int16), scratch(n + 1, np.int16, 0)
    symbols = scratch(n_lanes, np.uint8)
    table_of_sum = of_context[:, CONTEXT_OF_SUM].reshape(-1)
    at, n_ends = _decode(
        words, at, states, entries, table_of_sum, classes, neighbours, MIXED, found, near, symbols
    )
    check_scratch(found, near, symbols)
    return found, at, n_ends


@compiled
def _decode(words, at, states, entries, table_of_sum, classes, neighbours, mixed, found, near, symbols):
    n, n_lanes = len(classes), len(states)
    n_words, n_steps, n_longer, n_ends = len(words) - n_lanes, n // n_lanes, n % n_lanes, 0
    along_z, along_y, along_x = neighbours[0], neighbours[1], neighbours[2]
    bits, last, one, word = np.uint32(BITS), np.uint32(TOTAL - 1), np.uint32(1), np.uint32(16)
    begin = 0
    for step in range(n_steps + 1):
        n_active = n_lanes if step < n_steps else n_longer
        for lane in range(n_active):
            i = np.uint64(begin + lane)
            total = near[along_z[i]] + near[along_y[i]] + near[along_x[i]] + HALF
            x = states[lane]
            table = np.uint32(table_of_sum[np.uint32(classes[i] * N_MIXED + total)])
            entry = entries[(table << bits) | (x & last)]
            symbols[lane] = entry >> np.uint32(24)
            x = np.uint32(np.uint32(((entry >> bits) & last) + one) * np.uint32(x >> bits))
            x = np.uint32(x + (entry & last))
            low = x < np.uint32(65536)
            x = np.uint32((x << word) | words[np.uint64(at)]) if low else x
            at += low
            states[lane] = x
        row = np.uint64(step)
        for lane in range(n_active):  # only now: what is coded at the same step is not known
            symbol = symbols[lane]
            n_ends += (symbol == 0) | (symbol == 2 * END)
            near[row] = mixed[symbol]
            found[row] = np.int16(symbol) - END
            row += np.uint64(n_steps + (lane < n_longer))
        begin += n_lanes
        if at > n_words:
            return -1, 0
    return at, n_ends
