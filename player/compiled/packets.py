"""The march of LANES rays at a time, in step, each at a place of its own.

Rays beside one another meet the same bricks at nearly the same samples, so that a packet takes hardly more
steps than its longest ray does alone, and every step serves all of them. What `player.march.march` and
`player.march.contracted_march` state is done here in the same order, in float32. Compiled code alone imports
this.

A packet's numbers are float32 in rows of LANES, one of each ray. What is found is written in rows, too: s and
weight of sample j of all rays, the weight 0 where a ray has none. Where to fetch features is for
`player.compiled.fetches` to say.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

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
    splat,
    store,
    while_any,
)
from player.march.contracted import MIN_COS, SPARE
from player.march.march import MAX_TAU, SKIP_MARGIN

BOX_ROWS = 7
"""Rows of a packet in a box: point and direction in grid coordinates, length; see `march_box`."""
SPACE_ROWS = 10
"""Rows of a packet in contracted space: p, w d, cos and sin of phi_0, w, length; see `march_space`."""

SUMS = 5
"""Rows of what is summed up over a ray: tau, the number of density samples, the number of those with weight,
the sums of weight and of weight times s."""

Three = tuple[Lanes, Lanes, Lanes]


class _Grid(NamedTuple):
    """Addresses of the grid's arrays, and its numbers."""

    table: Any
    live: Any
    density: Any
    n_per_axis: Lanes
    last: Lanes
    """Of the cells along an axis."""
    low: Lanes
    slope: Lanes


class _Path(Protocol):
    """How samples lie on the rays of a packet."""

    def place(self, i: Lanes, active: Lanes) -> tuple[Lanes, Lanes, Three]:
        """s of the samples `i`, whether the rays reach so far, and their grid coordinates."""
        ...

    def jump(self, i: Lanes, g: Three, bricks: Three, reach: Lanes) -> Lanes:
        """The sample to look at next, from one in a brick around which all are empty within `reach`."""
        ...

    def way(self) -> Lanes:
        """Model units that the samples placed last stand for."""
        ...


class _Box:
    def __init__(self, b: Any, packet: Any, step: Lanes) -> None:
        rows = [load(b, packet, LONG(row * LANES)) for row in range(BOX_ROWS)]
        self._e, self._d, self._length = rows[:3], rows[3:6], rows[6]
        self._step = step
        self._per_step = 1.0 / self._step
        self._still = [d.call("fabs") <= 0 for d in self._d]
        self._inverse = [1.0 / d for d in self._d]

    def place(self, i: Lanes, active: Lanes) -> tuple[Lanes, Lanes, Three]:
        s = (i.to_float() + 0.5) * self._step
        x, y, z = (e + s * d for e, d in zip(self._e, self._d, strict=True))
        return s, active & (s < self._length), (x, y, z)

    def jump(self, i: Lanes, g: Three, bricks: Three, reach: Lanes) -> Lanes:
        leave = self._length
        for e, inverse, still, brick in zip(self._e, self._inverse, self._still, bricks, strict=True):
            ahead = ((brick + reach + 1) << 3).to_float() - float(SKIP_MARGIN)
            behind = ((brick - reach) << 3).to_float() + float(SKIP_MARGIN)
            border = choose(inverse > 0, ahead, behind)
            leave = choose(still, leave, leave.least((border - e) * inverse))
        return (i + 1).most((leave * self._per_step + 0.5).to_int())

    def way(self) -> Lanes:
        return self._step


class _Space:
    def __init__(self, b: Any, packet: Any, lattice: Any, pitch: Any, numbers: list[Lanes]) -> None:
        """pitch: samples that the lattice has, in 64 bits. numbers: cos and sin of half a step of phi, sin of
        a step, cells that a step makes at most, cells in a contracted unit."""
        rows = [load(b, packet, LONG(row * LANES)) for row in range(SPACE_ROWS)]
        self._p, self._wd = rows[:3], rows[3:6]
        self._cos0, self._sin0, self._width, self._length = rows[6:]
        self._lattice = [b.gep(lattice, [b.mul(pitch, LONG(row))]) for row in range(3)]
        self._end = splat(b, b.trunc(pitch, INT)) - SPARE
        self._cos_half, self._sin_half, self._sin_step, self._fastest, self._cells = numbers
        self._turned: tuple[Lanes, Lanes]

    def place(self, i: Lanes, active: Lanes) -> tuple[Lanes, Lanes, Three]:
        active = active & (i < self._end)
        s, cos_s, sin_s = (gather(row, i, 4, active).as_float() for row in self._lattice)
        cos = self._cos0 * cos_s - self._sin0 * sin_s
        sin = self._sin0 * cos_s + self._cos0 * sin_s
        self._turned = cos, sin
        v = [cos * p + sin * wd for p, wd in zip(self._p, self._wd, strict=True)]
        q = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).call("sqrt")
        scale = choose(q <= cos, 1.0 / cos, (2.0 - cos / q) / q) * self._cells
        middle = self._cells * 2.0
        x, y, z = (axis * scale + middle for axis in v)
        return s, active & (s < self._length), (x, y, z)

    def jump(self, i: Lanes, g: Three, bricks: Three, reach: Lanes) -> Lanes:
        free = None
        for x, brick in zip(g, bricks, strict=True):
            below = x - ((brick - reach) << 3).to_float()
            above = ((brick + reach + 1) << 3).to_float() - x
            here = below.least(above)
            free = here if free is None else free.least(here)
        assert free is not None
        return i + 1 + ((free - float(SKIP_MARGIN)) / self._fastest).to_int().most(0)

    def way(self) -> Lanes:
        cos, sin = self._turned
        a, b = cos * self._cos_half, sin * self._sin_half
        below = (a + b).most(float(MIN_COS)) * (a - b).most(float(MIN_COS))
        return self._width * self._sin_step / below


def _collect(b: Any, grid: _Grid, path: _Path, first: Lanes, samples: Any, pitch: Any, out: Any) -> Any:
    """March a packet from the samples `first` on: s into `samples`, weights `pitch` numbers behind; SUMS of
    each ray into `out`. Returns how many rows were written."""
    zero = grid.low.like(0.0)
    i, taken, active = Variable(first), Variable(first.like(0)), Variable(first >= 0)
    tau, trans, n_weights = Variable(zero), Variable(zero.like(1.0)), Variable(zero)
    total, moment = _Sum(zero), _Sum(zero)
    n_rows = cgutils.alloca_once_value(b, LONG(0))
    with while_any(b, active):
        now = i.get()
        s, inside, g = path.place(now, active.get())
        top = grid.last.to_float()
        cell = [x.most(0.0).least(top).to_int() for x in g]
        bricks = (cell[0] >> 3, cell[1] >> 3, cell[2] >> 3)
        number = (bricks[0] * grid.n_per_axis + bricks[1]) * grid.n_per_axis + bricks[2]
        slot = gather(grid.table, number, 4, inside)
        empty = inside & (slot < 0)
        busy = inside & (slot > -1)
        i.set(now + 1)
        active.set(inside)
        with b.if_then(empty.any()):
            i.set(choose(empty, path.jump(now, g, bricks, -slot - 1), now + 1))
        with b.if_then(busy.any()):  # a grid without a slot has nothing to read
            within = [c & 7 for c in cell]
            word = gather(grid.live, (slot << 4) + (within[0] << 1) + (within[1] >> 2), 4, busy)
            bit = ((within[1] & 3) << 3) + within[2]
            lit = Lanes(b, b.lshr(word.value, bit.value)) & 1
            live = lit.is_not(0)
            with b.if_then(live.any()):
                at = slot.wide() * 729 + (within[0] * 81 + within[1] * 9 + within[2]).wide()
                f = [x - c.to_float() for x, c in zip(g, cell, strict=True)]
                code = _trilinear(grid.density, at, f, live)
                optical = (grid.low + grid.slope * code).exp() * path.way()
                optical = choose(live, optical, zero)
                before = trans.get()
                depth = tau.get() + optical
                behind = (-depth).exp()
                series = 1.0 - optical * (1 / 2 - optical * (1 / 6 - optical * (1 / 24)))
                weight = choose(optical > 0.1, before - behind, before * optical * series)
                weight = choose(live & (weight > 0), weight, zero)
                tau.set(depth)
                trans.set(choose(live, behind, before))
                taken.set(taken.get() + lit)
                n_weights.set(choose(weight > 0, n_weights.get() + 1, n_weights.get()))
                total.add(weight)
                moment.add(weight * s)
                active.set(inside & ~(depth > float(MAX_TAU)))
                row = b.load(n_rows)
                place = b.mul(row, LONG(LANES))
                store(samples, place, s)
                store(samples, b.add(place, pitch), weight)
                b.store(b.add(row, LONG(1)), n_rows)
    sums = tau.get(), taken.get().to_float(), n_weights.get(), total.get(), moment.get()
    for row, values in enumerate(sums):
        store(out, LONG(row * LANES), values)
    return b.load(n_rows)


class _Sum:
    """Of many numbers to the rounding of the last: Kahan's."""

    def __init__(self, zero: Lanes) -> None:
        self._sum, self._lost = Variable(zero), Variable(zero)

    def add(self, number: Lanes) -> None:
        missing = number - self._lost.get()
        total = self._sum.get() + missing
        self._lost.set((total - self._sum.get()) - missing)
        self._sum.set(total)

    def get(self) -> Lanes:
        return self._sum.get()


def _trilinear(density: Any, at: Lanes, f: list[Lanes], where: Lanes) -> Lanes:
    """Codes between the corners of cells: along z, then y, then x."""

    def along_z(offset: int) -> Lanes:
        pair = gather(density, at, 1, where, offset=offset)
        low, high = (pair & 255).to_float(), ((pair >> 8) & 255).to_float()
        return low + (high - low) * f[2]

    c00, c01, c10, c11 = (along_z(offset) for offset in (0, 9, 81, 90))
    c0, c1 = c00 + (c01 - c00) * f[1], c10 + (c11 - c10) * f[1]
    return c0 + (c1 - c0) * f[0]


def _grid(context: Any, b: Any, kinds: Any, arrays: Any, numbers: Any) -> _Grid:
    """From (table, live, density) and (resolution, n_per_axis, low, slope)."""
    table, live, density = (
        address(context, b, kind, b.extract_value(arrays, n)) for n, kind in enumerate(kinds)
    )
    resolution, n_per_axis = (splat(b, b.trunc(b.extract_value(numbers, n), INT)) for n in range(2))
    low, slope = (splat(b, b.extract_value(numbers, n)) for n in (2, 3))
    return _Grid(table, live, density, n_per_axis, resolution - 1, low, slope)


def _march_box(
    _: Any, lookup: Any, numbers: Any, step: Any, packet: Any, first: Any, samples: Any, out: Any
) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        grid = _grid(context, b, signature.args[0], arguments[0], arguments[1])
        rows, start, places, found = (
            address(context, b, signature.args[n], arguments[n]) for n in range(3, 7)
        )
        pitch = b.udiv(context.make_array(samples)(context, b, arguments[5]).nitems, LONG(2))
        path = _Box(b, rows, splat(b, arguments[2]))
        return _collect(b, grid, path, load(b, start, LONG(0), INT), places, pitch, found)

    return types.int64(lookup, numbers, step, packet, first, samples, out), generate


march_box: Any = intrinsic(_march_box)
"""march_box((table, live, density), (resolution, n_per_axis, low, slope), step, packet [BOX_ROWS, LANES]
float32, first [LANES] int32, samples [2, n, LANES] float32, out [SUMS, LANES] float32): rows written.

`packet` has the entry points x, y, z and directions x, y, z in grid coordinates, and lengths; 0 where there
is no ray. Into `samples` go s and weights. `samples` has room for the most samples that a ray can have.
"""


def _march_space(
    _: Any, lookup: Any, numbers: Any, lattice: Any, steps: Any, packet: Any, samples: Any, out: Any
) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        grid = _grid(context, b, signature.args[0], arguments[0], arguments[1])
        table, rows, places, found = (
            address(context, b, signature.args[n], arguments[n]) for n in (2, 4, 5, 6)
        )
        pitch = b.udiv(context.make_array(samples)(context, b, arguments[5]).nitems, LONG(2))
        n = b.udiv(context.make_array(lattice)(context, b, arguments[2]).nitems, LONG(3))
        of_steps = [splat(b, b.extract_value(arguments[3], i)) for i in range(5)]
        path = _Space(b, rows, table, n, of_steps)
        return _collect(b, grid, path, grid.last.like(0), places, pitch, found)

    return types.int64(lookup, numbers, lattice, steps, packet, samples, out), generate


march_space: Any = intrinsic(_march_space)
"""march_space((table, live, density), (resolution, n_per_axis, low, slope), lattice [3, n] float32, steps,
packet [SPACE_ROWS, LANES] float32, samples [2, n, LANES] float32, out [SUMS, LANES] float32): rows written.

`steps` are five float32: cos and sin of half a step of phi, sin of a step, cells that a step makes at most,
cells in a contracted unit. `packet` has p, w d, cos and sin of phi_0, w and the length; 0 where there is no
ray. The rest as in `march_box`.
"""
