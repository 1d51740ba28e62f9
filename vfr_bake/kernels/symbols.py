"""Choice of the symbols that a level of a pyramid stores, by their bits and by the error they make in
pictures.

Letters: vertex v of a level has the symbol s, so that its value is predicted[v] + step s; d is the difference
of that value from the wanted one. The symbol is chosen for which

    weights[v] d^2 + bits[context, s]

is least: a weight is the number of bits worth spending to reduce d^2 by 1. The context is that of
`player.asset.coder`; it follows from the symbols that were chosen before.
"""

from __future__ import annotations

import numpy as np

from player.asset.coder.tables import END, HALF, N_CONTEXTS
from vfr_bake.kernels import njit

TRIED = 2
"""Number of symbols that are tried beside 0: the nearest, and the next towards 0."""


@njit(cache=True)
def add_squares(starts, rows, shares, slopes, changed, out):
    """Add to `out` [n_vertices] the squared changes of all rays for a change of each vertex by 1.

    Fetch j of ray i, starts[i] <= j < starts[i + 1], changes the ray by slopes[j] shares[j, c] for each unit
    of the value at rows[j, c]. A ray often meets a vertex more than once; these changes are added up before
    they are squared. `changed` [n_vertices] is scratch for the sums: 0 before and after.
    """
    for i in range(len(starts) - 1):
        for j in range(starts[i], starts[i + 1]):
            for corner in range(8):
                changed[rows[j, corner]] += slopes[j] * shares[j, corner]
        for j in range(starts[i], starts[i + 1]):
            for corner in range(8):
                row = rows[j, corner]
                if changed[row] != 0:
                    out[row] += changed[row] * changed[row]
                    changed[row] = 0


@njit(cache=True)
def add_to_coarser(masks, bricks, rows, values, out):
    """Add the values [n] of a finer level's vertices to `out` [n_coarse]. Each is divided among the coarser
    vertices that predict it, by their shares in the prediction.

    `masks` [n_bricks, 8] uint64 say which vertices the finer level has; `bricks` and `rows` are the members
    of its `player.asset.prediction.prediction.Places`.
    """
    row = 0
    for brick in range(len(masks)):
        first = np.int64(bricks[brick, 0]) * 729
        x0, y0, z0 = bricks[brick, 1], bricks[brick, 2], bricks[brick, 3]
        for x in range(8):
            word = masks[brick, x]
            for bit in range(64 if word else 0):
                if not (word >> np.uint64(bit)) & np.uint64(1):
                    continue
                y, z = bit >> 3, bit & 7
                share = values[row] * np.float32(0.125)
                for corner in range(8):
                    at = (x0 + ((x + (corner >> 2)) >> 1)) * 81
                    at += (y0 + ((y + ((corner >> 1) & 1)) >> 1)) * 9
                    at += z0 + ((z + (corner & 1)) >> 1)
                    out[rows[first + at]] += share
                row += 1


@njit(cache=True)
def from_coarser(masks, bricks, rows, values, out):
    """Write to `out` [n] the values at a level's vertices that are predicted, as floats, from the values
    [n_coarse] of the next coarser level; other arguments as for `add_to_coarser`."""
    row = 0
    for brick in range(len(masks)):
        first = np.int64(bricks[brick, 0]) * 729
        x0, y0, z0 = bricks[brick, 1], bricks[brick, 2], bricks[brick, 3]
        for x in range(8):
            word = masks[brick, x]
            for bit in range(64 if word else 0):
                if not (word >> np.uint64(bit)) & np.uint64(1):
                    continue
                y, z = bit >> 3, bit & 7
                total = np.float32(0)
                for corner in range(8):
                    at = (x0 + ((x + (corner >> 2)) >> 1)) * 81
                    at += (y0 + ((y + ((corner >> 1) & 1)) >> 1)) * 9
                    at += z0 + ((z + (corner & 1)) >> 1)
                    total += values[rows[first + at]]
                out[row] = total * np.float32(0.125)
                row += 1


@njit(cache=True)
def choose(
    wanted, predicted, weights, neighbours, classes, bits, context_of_sum, mixed, limits, near, values, seen
):
    """Choose the values that one channel of a level stores.

    Args:
        wanted: [n] float32: the values before quantization.
        predicted: [n] int16: the prediction from the coarser level.
        weights: [n] float32.
        neighbours: [3, n] int32: rows of the neighbours, n for one that does not exist.
        classes: [n] uint8.
        bits: [n_classes * 81, 127] float32: bits that the symbols -63 to 63 take in each context.
        context_of_sum, mixed: of `player.asset.coder.tables`.
        limits: step, lowest and highest value.
        near: [n + 1] int16, scratch; the last number must be 0.
        values: [n] int16, written.
        seen: [n_classes * 81, 127] int64: the number of times each symbol is chosen is added to it.

    Returns:
        The sum of weights d^2, and the sum of the bits.
    """
    step, low, high = limits
    distortion, rate = 0.0, 0.0
    for v in range(len(wanted)):
        total = near[neighbours[0, v]] + near[neighbours[1, v]] + near[neighbours[2, v]] + HALF
        context = classes[v] * N_CONTEXTS + context_of_sum[total]
        here, away = np.int32(predicted[v]), wanted[v] - np.float32(predicted[v])
        best, best_cost = 0, weights[v] * away * away + bits[context, END]
        best_square, nearest = weights[v] * away * away, np.int32(np.rint(away / np.float32(step)))
        towards = 1 if nearest < 0 else -1
        for _ in range(TRIED):
            if nearest == 0:
                break
            if low <= here + step * nearest <= high:
                left = away - np.float32(step * nearest)
                square = weights[v] * left * left
                cost = square + bits[context, min(max(nearest, -END), END) + END]
                if cost < best_cost:
                    best, best_cost, best_square = nearest, cost, square
            nearest += towards
        known = min(max(best, -END), END) + END
        values[v] = here + step * best
        near[v] = mixed[known]
        seen[context, known] += 1
        distortion += best_square
        rate += bits[context, known]
    return distortion, rate
