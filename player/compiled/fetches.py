"""Choice of where a packet of rays fetches features, and of the rows it reads: LANES rays at a time, in
registers.

This computes what `player.march.fetches` defines, in float32 and in one pass over the samples. Only compiled
code imports this module.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from player.compiled.lanes import (
    INT,
    LANES,
    LONG,
    Lanes,
    Variable,
    address,
    choose,
    gather,
    load,
    scatter,
    splat,
    store,
    unpacked,
    while_any,
)
from player.compiled.packets import N_WEIGHTS, TOTAL, brick_number, corner_number


class _Chosen:
    """Writer of the table of fetches, [3, n, LANES] float32: s, weight, and the s to use if little is stored
    at the first."""

    def __init__(self, base: Any, most: Any, lane: Lanes) -> None:
        """`most`: the most fetches that a ray can have, k, in 64 bits."""
        b = lane.b
        self._rows = [b.gep(base, [b.mul(most, LONG(row * LANES))]) for row in range(3)]
        self._lane = lane
        self.n = Variable(lane.like(0))

    def add(self, s: Lanes, weight: Lanes, other: Lanes, where: Lanes) -> None:
        """Append a fetch to the rays that are true in `where`."""
        n = self.n.get()
        at = n * LANES + self._lane
        for row, values in zip(self._rows, (s, weight, other), strict=True):
            scatter(row, at, values, where)
        self.n.set(choose(where, n + 1, n))


def _choose_fetches(_: Any, samples: Any, n_rows: Any, sums: Any, mass: Any, chosen: Any) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        places, summed, opacity, table = (
            address(context, b, signature.args[n], arguments[n]) for n in (0, 2, 3, 4)
        )
        pitch = b.udiv(context.make_array(samples)(context, b, arguments[0]).nitems, LONG(2))
        most = b.udiv(context.make_array(chosen)(context, b, arguments[4]).nitems, LONG(3 * LANES))
        room = splat(b, b.trunc(most, INT))
        one_each = Lanes(b, ir.Constant(ir.VectorType(INT, LANES), list(range(LANES))))
        n_weights, total = (load(b, summed, LONG(row * LANES)) for row in (N_WEIGHTS, TOTAL))
        bins = room.to_float()
        visible = load(b, opacity, LONG(0))
        zero = total.like(0.0)
        out = _Chosen(table, most, one_each)
        cut = n_weights > bins  # rays with more samples than bins
        share, weight_of_bin = total / bins, visible / bins
        no_other = zero.like(float("nan"))
        need, moment = Variable(share), Variable(zero)
        heaviest, of_heaviest = Variable(zero.like(-1.0)), Variable(zero)
        with cgutils.for_range(b, arguments[1]) as loop:
            at = b.mul(loop.index, LONG(LANES))
            s, weight = load(b, places, at), load(b, places, b.add(at, pitch))
            there = (weight > 0) & (visible > 0)
            with b.if_then((there & ~cut).any()):
                out.add(s, weight, no_other, there & ~cut)
            left, active = Variable(weight), Variable(there & cut & (out.n.get() < room))
            with while_any(b, active):
                now = active.get()
                part = choose(now, left.get().least(need.get()), zero)
                moment.set(moment.get() + part * s)
                heavier = now & (part > heaviest.get())
                of_heaviest.set(choose(heavier, s, of_heaviest.get()))
                heaviest.set(choose(heavier, part, heaviest.get()))
                need.set(need.get() - part)
                left.set(left.get() - part)
                full = now & (need.get() <= 0)
                with b.if_then(full.any()):
                    out.add(moment.get() / share, weight_of_bin, of_heaviest.get(), full)
                    need.set(choose(full, share, need.get()))
                    moment.set(choose(full, zero, moment.get()))
                    heaviest.set(choose(full, heaviest.get().like(-1.0), heaviest.get()))
                active.set(now & (left.get() > 0) & (out.n.get() < room))
        # a last bin whose mass is not full, because of rounding in float32
        begun = cut & (visible > 0) & (need.get() < share) & (out.n.get().to_float() < bins)
        with b.if_then(begun.any()):
            out.add(moment.get() / (share - need.get()), weight_of_bin, of_heaviest.get(), begun)
        n = out.n.get()
        longest = n.greatest()
        with cgutils.for_range(b, b.sext(longest, LONG)) as loop:  # rays with fewer get weight 0
            row = b.mul(loop.index, LONG(LANES))
            behind = b.add(row, b.mul(most, LONG(LANES)))
            beyond = n <= splat(b, b.trunc(loop.index, INT))
            with b.if_then(beyond.any()):
                store(table, behind, choose(beyond, zero, load(b, table, behind)))
                store(table, row, choose(beyond, zero, load(b, table, row)))
        return b.sext(longest, LONG)

    return types.int64(samples, types.int64, sums, mass, chosen), generate


choose_fetches: Any = intrinsic(_choose_fetches)
"""choose_fetches(samples [2, n, LANES] float32, n_rows, sums [SUMS, LANES] float32, mass [LANES] float32,
chosen [3, k, LANES] float32): choose where rays fetch features; returns the number of rows of `chosen`
written.

`samples`, of which `n_rows` rows count, and `sums` are results of a march of `player.compiled.packets`.
`mass` is the opacity of each ray, 0 where nothing is to be fetched. `chosen` gets s and weight of each fetch,
and the s to fetch at instead if little is stored at the first, NaN for none. Where a ray has fewer fetches
than others, its weight is 0. k is at least 1: to fetch at every sample, `samples` themselves are the fetches.
"""


class StoredFeatures(NamedTuple):
    """The features of a `player.asset.grid.SparseGrid`, and the grid of their vertices."""

    bricks: np.ndarray
    rows: np.ndarray
    features: np.ndarray
    resolution: int
    n_per_axis: int
    scale: np.float32
    """Cells of the features' grid per cell of the densities' grid, along an axis."""


def _stored_corners(_: Any, stored: Any, places: Any, weights: Any, rows: Any, shares: Any) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        grid = unpacked(context, b, signature.args[0], arguments[0])
        at, weight_at, row_at, share_at = (
            address(context, b, signature.args[n], arguments[n]) for n in range(1, 5)
        )
        resolution, n_per_axis = (splat(b, b.trunc(n, INT)) for n in (grid.resolution, grid.n_per_axis))
        scale = splat(b, grid.scale)
        g = [
            (load(b, at, LONG(axis * LANES)) * scale).most(0.0).least(resolution.to_float())
            for axis in range(3)
        ]
        low = [x.to_int().least(resolution - 1) for x in g]
        held = gather(grid.bricks, brick_number(low, n_per_axis), 4, resolution > 0)
        level = choose(held > -1, held & 7, 0)
        width = ((127 - level) << 23).as_float()
        low = [cell >> level for cell in low]
        share = []
        for x, cell in zip(g, low, strict=True):
            fraction = x * width - cell.to_float()
            share.append((1.0 - fraction, fraction))
        first = corner_number(held >> 3, low)
        total = scale.like(0.0)
        parts = []
        for x, y in np.ndindex(2, 2):
            pair = gather(grid.rows, first, 4, held > -1, LONG, x * 81 + y * 9).halves()
            for z, row in enumerate(pair):
                there = (held > -1) & (row > -1)
                parts.append(
                    (choose(there, row, 0), choose(there, share[0][x] * share[1][y] * share[2][z], 0.0))
                )
                total = total + parts[-1][1]
        weight = load(b, weight_at, LONG(0)) / total
        most = parts[0][0]
        for corner, (row, part) in enumerate(parts):
            store(row_at, LONG(corner * LANES), row)
            store(share_at, LONG(corner * LANES), part * weight)
            most = most.most(row)
        store(share_at, LONG(8 * LANES), total)
        return b.sext(most.greatest(), LONG)

    return types.int64(stored, places, weights, rows, shares), generate


stored_corners: Any = intrinsic(_stored_corners)
"""stored_corners(stored: StoredFeatures, places [3, LANES] float32, weights [LANES] float32, rows [8, LANES]
int32, shares [9, LANES] float32): find the stored corners around LANES places; returns the greatest of their
rows.

`places` are in cells of the densities' grid. `rows` gets the row of each corner. `shares` gets the corner's
interpolation weight, divided by the sum of those of all stored corners and multiplied by the place's number
in `weights`. For a corner that is not stored, both are 0. The last row of `shares` gets the sum over the
stored corners; where that sum is 0, the shares are NaN.
"""
