"""Operations on LANES samples of one ray at a time, in registers: their points, what hash grids hold there,
and their weights. All in float32; letters as in `vfr_bake.kernels.proposals` and
`vfr_bake.kernels.hash_grid`."""

from __future__ import annotations

from typing import Any

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
    load,
    splat,
    store,
    unpacked,
    vector,
)
from vfr_bake.kernels.hash_grid import PRIME_Y, PRIME_Z

Three = tuple[Lanes, Lanes, Lanes]

SERIES = (1 / 5040, -1 / 720, 1 / 120, -1 / 24, 1 / 6, -1 / 2, 1.0)
"""Coefficients of the series of (1 - exp(-y)) / y, highest power first; accurate to 2e-8 for y below THIN."""
THIN = 0.35
"""Optical depth y above which 1 - exp(-y) can be computed directly without losing digits that matter."""


def distance(s: Lanes) -> Lanes:
    """Return t for spacing coordinates s in [0, 1)."""
    return choose(s < 0.5, s * 2.0, 1.0 / ((1.0 - s) * 2.0))


def contracted(point: Three) -> Three:
    """Return the points of the unit cube for points of the model frame, as
    `vfr_bake.kernels.contraction.contracted_unit` does."""
    x, y, z = point
    largest = x.call("fabs").most(y.call("fabs")).most(z.call("fabs")).most(0.5)
    a, b, c = (value / largest for value in point)
    norm = largest * (a * a + b * b + c * c).call("sqrt")
    scale = choose(norm > 1, (2.0 - 1.0 / norm) / norm, 1.0) * 0.25
    return x * scale + 0.5, y * scale + 0.5, z * scale + 0.5


def opacity(depth: Lanes) -> Lanes:
    """Return 1 - exp(-depth) for optical depths, with a relative error of at most 5e-7."""
    thin = depth.like(SERIES[0])
    for coefficient in SERIES[1:]:
        thin = thin.call("fma", depth, coefficient)
    return choose(depth < THIN, depth * thin, 1.0 - (-depth).exp())


def gathered(base: Any, index: Lanes, kind: Any) -> Lanes:
    """Return the integers of type `kind` at the places `index` counted from the address `base`.

    This uses the processor's gather instruction where LLVM knows that it is fast. Rows of a table take longer
    to arrive from memory than to be read, and with gather instructions more of them are under way at a time.
    Field samples take 0.7 to 0.8 of the time that they take with loads one by one.
    """
    b, bits = index.b, kind.width
    start = splat(b, b.ptrtoint(base, LONG)).value
    behind = b.mul(index.wide().value, ir.Constant(vector(LONG), [bits // 8] * LANES))
    places = b.inttoptr(b.add(behind, start), ir.VectorType(ir.PointerType(kind), LANES))
    all_of_them = ir.Constant(ir.VectorType(ir.IntType(1), LANES), [1] * LANES)
    words = vector(kind)
    arguments = [places.type, INT, all_of_them.type, words]
    function = cgutils.get_or_insert_function(
        b.module, ir.FunctionType(words, arguments), f"llvm.masked.gather.v{LANES}i{bits}.v{LANES}p0"
    )
    return Lanes(b, b.call(function, [places, INT(4), all_of_them, ir.Constant(words, ir.Undefined)]))


def sums_before(values: Lanes) -> tuple[Lanes, Any]:
    """Return the sum of the lanes before each lane, and the sum of all lanes as one number."""
    b, zero = values.b, values.like(0.0)

    def later(lanes: Lanes, by: int) -> Lanes:
        places = ir.Constant(vector(INT), [LANES - by + n for n in range(LANES)])
        return Lanes(b, b.shuffle_vector(zero.value, lanes.value, places))

    total, by = values, 1
    while by < LANES:
        total, by = total + later(total, by), 2 * by
    return later(total, 1), b.extract_element(total.value, INT(LANES - 1))


class _Level:
    """Level of a hash grid, with the cells that LANES points of the unit cube lie in."""

    def __init__(self, b: Any, grid: Any, level: Any, point: Three) -> None:
        def entry(array: Any) -> Any:
            return b.load(b.gep(array, [level]))

        scale = splat(b, entry(grid.scales))
        last = scale.to_int() - 1
        places = [value * scale for value in point]
        self._cell = [place.to_int().most(0).least(last) for place in places]
        self._inside = [place - cell.to_float() for place, cell in zip(places, self._cell, strict=True)]
        self._side = last + 2
        self._hashed = b.trunc(entry(grid.hashed), ir.IntType(1))
        self._mask = splat(b, b.trunc(grid.mask, INT))
        self.first = entry(grid.offsets)
        """Row of the table at which the level begins."""

    def corners(self) -> list[tuple[Lanes, Lanes]]:
        """Return (row, trilinear weight) of the eight corners, x fastest; rows count from the level's
        first."""
        x, y, z = self._cell
        b, side = x.b, self._side
        by_y, by_z = y * _signed(PRIME_Y), z * _signed(PRIME_Z)
        hashes = [(x, x + 1), (by_y, by_y + _signed(PRIME_Y)), (by_z, by_z + _signed(PRIME_Z))]
        row = (z * side + y) * side + x
        shares = [(1.0 - inside, inside) for inside in self._inside]
        found = []
        for corner in range(8):
            i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
            shared = (hashes[0][i] ^ hashes[1][j] ^ hashes[2][k]) & self._mask
            own = row + i
            if j:
                own = own + side
            if k:
                own = own + side * side
            at = Lanes(b, b.select(self._hashed, shared.value, own.value))
            found.append((at, shares[0][i] * (shares[1][j] * shares[2][k])))
        return found


def _signed(prime: Any) -> int:
    """Return the int32 with the bits of a uint32."""
    return int(prime) - (1 << 32 if int(prime) >> 31 else 0)


def _points_at(b: Any, origin: Any, direction: Any, edges: Any, first: Any) -> tuple[Lanes, Lanes, Three]:
    """Return (t, lengths, points of the unit cube) for the LANES intervals from number `first` on; t and the
    points are those of their middles."""
    near, far = distance(load(b, edges, first)), distance(load(b, edges, b.add(first, LONG(1))))
    t = (near + far) * 0.5

    def along(axis: int) -> Lanes:
        start, step = (splat(b, b.load(b.gep(base, [LONG(axis)]))) for base in (origin, direction))
        return start + t * step

    return t, far - near, contracted((along(0), along(1), along(2)))


def _propose_lanes(
    _: Any, rays_o: Any, rays_d: Any, edges: Any, first: Any, grid: Any, limits: Any, tau: Any, points: Any,
    depths: Any, weights: Any,
) -> Any:  # fmt: skip

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        origin, direction, borders, at, depth_at, weight_at = (
            address(context, b, signature.args[n], arguments[n]) for n in (0, 1, 2, 7, 8, 9)
        )
        j = arguments[3]
        held = unpacked(context, b, signature.args[4], arguments[4])
        largest, opaque = (splat(b, b.extract_value(arguments[5], n)) for n in range(2))
        _, lengths, point = _points_at(b, origin, direction, borders, j)
        pitch = b.udiv(context.make_array(points)(context, b, arguments[7]).nitems, LONG(3))
        for axis, values in enumerate(point):
            store(at, b.add(j, b.mul(pitch, LONG(axis))), values)
        total = Variable(lengths.like(0.0))
        scales = b.extract_value(arguments[4], 1)
        n_levels = context.make_array(signature.args[4].types[1])(context, b, scales).nitems
        with cgutils.for_range(b, n_levels) as loop:
            level = _Level(b, held, loop.index, point)
            table = b.gep(held.table, [level.first])
            logit = total.get()
            for row, share in level.corners():
                logit = share.call("fma", gathered(table, row, INT).as_float(), logit)
            total.set(logit)
        logit = total.get()
        depth = choose(logit > largest, largest, logit).exp() * lengths
        before, all_of_them = sums_before(depth)
        before = before + splat(b, arguments[6])
        behind = before > opaque
        store(depth_at, j, choose(behind, lengths.like(0.0), depth))
        store(weight_at, j, choose(behind, lengths.like(0.0), (-before).exp() * opacity(depth)))
        return b.fadd(arguments[6], all_of_them)

    arrays = rays_o, rays_d, edges, types.int64, grid, limits, types.float32, points, depths, weights
    return types.float32(*arrays), generate


propose_lanes: Any = intrinsic(_propose_lanes)
"""propose_lanes(origin [3], direction [3], edges [n + 1], first, grid, limits, tau, points [3, n], depths
[n], weights [n]), all of one ray and in float32: process the intervals `first` to `first` + LANES - 1, before
which the optical depth is `tau`, and return the optical depth behind them.

The middles of these intervals are written to `points`, the optical depths that a proposal's `grid` gives them
to `depths`, and their weights to `weights`; depths and weights are 0 behind an opaque interval. n is a
multiple of LANES.
"""


def _look_up_lanes(
    _: Any, rays_o: Any, rays_d: Any, edges: Any, first: Any, grid: Any, places: Any, features: Any
) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        origin, direction, borders, place_at, feature_at = (
            address(context, b, signature.args[n], arguments[n]) for n in (0, 1, 2, 5, 6)
        )
        j = arguments[3]
        held = unpacked(context, b, signature.args[4], arguments[4])
        t, lengths, point = _points_at(b, origin, direction, borders, j)
        for row, values in enumerate((t, lengths, *point)):
            store(place_at, LONG(row * LANES), values)
        scales = b.extract_value(arguments[4], 1)
        n_levels = context.make_array(signature.args[4].types[1])(context, b, scales).nitems
        with cgutils.for_range(b, n_levels) as loop:
            level = _Level(b, held, loop.index, point)
            table = b.gep(held.table, [b.mul(level.first, LONG(2))])
            sums = [lengths.like(0.0), lengths.like(0.0)]
            for row, share in level.corners():
                words = gathered(table, row, LONG).halves()
                sums = [share.call("fma", w.as_float(), s) for w, s in zip(words, sums, strict=True)]
            start = b.gep(feature_at, [b.mul(loop.index, LONG(2))])
            pitch = b.mul(n_levels, LONG(2))
            for lane in range(LANES):
                row_at = b.gep(start, [b.mul(pitch, LONG(lane))])
                for channel, values in enumerate(sums):
                    value = b.extract_element(values.value, INT(lane))
                    b.store(value, b.gep(row_at, [LONG(channel)]))
        return context.get_dummy_value()

    arrays = rays_o, rays_d, edges, types.int64, grid, places, features
    return types.void(*arrays), generate


look_up_lanes: Any = intrinsic(_look_up_lanes)
"""look_up_lanes(origin [3], direction [3], edges [n + 1], first, grid, places [5, LANES], features [LANES, 2
n_levels]), all of one ray and in float32: look up the intervals `first` to `first` + LANES - 1.

Their t, their lengths, and x, y, z of their middles in the unit cube are written to `places`; the features
that the hash grid `grid`, of two channels, has at their middles are written to `features`.
"""
