"""The march of packets of LANES rays: the rays of a packet take their steps together, each at its own
position.

Neighbouring rays meet the same bricks at nearly the same samples. So a packet takes hardly more steps than
its longest ray would alone, and every step serves all of its rays. The march does what `player.march.march`
defines, in the same order and in float32, on either path of `player.march.path`. Only compiled code imports
this module.

A packet's numbers are float32 in rows of LANES, one number for each ray. Samples are written in rows, too: s
and weight of sample j of all rays, with weight 0 where a ray has none. `player.compiled.fetches` decides
where features are fetched.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from player.asset.grid import DISTANCE_BITS, MAX_DISTANCE
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
    unpacked,
    while_any,
)
from player.march.box import SKIP_MARGIN
from player.march.contracted import MIN_COS
from player.march.march import MAX_TAU


class Lookup(NamedTuple):
    """The parts of a `player.asset.grid.SparseGrid` that a march reads."""

    table: np.ndarray
    live: np.ndarray
    density: np.ndarray
    level_steps: np.ndarray
    resolution: int
    n_per_axis: int
    least_coarse: int
    """The first level whose samples may stand for several steps: 1 if those of the finest level stand for
    one, else 0."""
    most_steps: int
    """The most base steps that a sample stands for."""
    density_low: np.float32
    density_slope: np.float32
    opaque_depth: np.float32
    """The optical depth at which rays stop; see `player.march.march.march`."""


class BoxSteps(NamedTuple):
    """The numbers that all rays through a box share."""

    step: np.float32
    """Length of a base step, model units."""


class SpaceSteps(NamedTuple):
    """The numbers that all rays through contracted space share."""

    middles: np.ndarray
    """[n_steps, 2] float32: cos and sin of s at the middles of base steps, side by side, so that one read of
    64 bits gets both. s itself is computed by the same product as in the lattice of
    `player.march.contracted`."""
    ends: np.ndarray
    """[n_steps, 2] float32: the same at the ends of base steps."""
    step: np.float32
    """dphi."""
    angles: np.ndarray
    """[3, n_sizes] float32, indexed by a number of base steps: cos and sin of half their angle, and sin of
    their angle."""
    n_steps: int
    n_sizes: int
    fastest: np.float32
    """The most cells that a ray moves in one base step."""
    cells: np.float32
    """Cells per contracted unit."""


BOX_ROWS = 9
"""Rows of a packet in a box: entry point x, y, z and direction x, y, z in grid coordinates, length, t of the
entry, first base step. A length of 0 stands for no ray."""
LENGTH, ENTRY, FIRST = 6, 7, 8
"""Numbers of the rows for length, t of the entry and first base step."""
SPACE_ROWS = 11
"""Rows of a packet in contracted space: p and w d, x, y, z each, cos and sin of phi_0, w, length, t_p
(`player.march.contracted.ContractedPath`). A length of 0 stands for no ray."""

TAU, N_SAMPLES, N_WEIGHTS, TOTAL, DEPTH = range(5)
"""Rows of the results of a march, for each ray: its optical depth, the number of density samples, the number
of samples with weight, the sum of the weights, and t at the weighted mean position."""
SUMS = 5
"""Number of these rows."""

Three = tuple[Lanes, Lanes, Lanes]


class _Box:
    """The path of a packet through a box: `player.march.box.BoxPath` for LANES rays."""

    def __init__(self, b: Any, packet: Any, steps: BoxSteps) -> None:
        rows = [load(b, packet, LONG(row * LANES)) for row in range(BOX_ROWS)]
        self._e, self._d = rows[:3], rows[3:6]
        self._length, self._entry, self._first = rows[LENGTH], rows[ENTRY], rows[FIRST]
        self._step = splat(b, steps.step)
        self._per_step = 1.0 / self._step
        self._way = Variable(self._step)
        self._still = [d.call("fabs") <= 0 for d in self._d]
        self._inverse = [1.0 / d for d in self._d]

    def first(self) -> Lanes:
        """Return the first base steps to look at."""
        return self._first.to_int()

    def place(self, i: Lanes, active: Lanes) -> tuple[Lanes, Lanes, Three]:
        """Return s at the middles of base steps `i`, whether the rays reach that far, and the grid
        coordinates there."""
        s = (i.to_float() + 0.5) * self._step
        self._way.set(self._step)
        return s, active & (s < self._length), self.at(s)

    def place_group(self, i: Lanes, size: Lanes, where: Lanes) -> tuple[Lanes, Lanes, Three]:
        """Do the same as `place` for the middles of `size` base steps from `i` on, in the lanes that are true
        in `where`; `way` keeps its former values in the others."""
        s = (i.to_float() + size.to_float() * 0.5) * self._step
        self._way.set(choose(where, size.to_float() * self._step, self._way.get()))
        return s, where & (s < self._length), self.at(s)

    def jump(self, i: Lanes, g: Three, bricks: Three, reach: Lanes) -> Lanes:
        """Return the base step to look at next after step `i`, which is in a brick around which all bricks
        are empty within `reach`."""
        leave = self._length
        for e, inverse, still, brick in zip(self._e, self._inverse, self._still, bricks, strict=True):
            ahead = ((brick + reach + 1) << 3).to_float() - float(SKIP_MARGIN)
            behind = ((brick - reach) << 3).to_float() + float(SKIP_MARGIN)
            border = choose(inverse > 0, ahead, behind)
            leave = choose(still, leave, leave.least((border - e) * inverse))
        return (i + 1).most((leave * self._per_step + 0.5).to_int())

    def way(self) -> Lanes:
        """Return the length of ray, model units, that the samples placed last stand for."""
        return self._way.get()

    def at(self, s: Lanes) -> Three:
        """Return the grid coordinates at the positions `s`."""
        x, y, z = (e + s * d for e, d in zip(self._e, self._d, strict=True))
        return x, y, z

    def distance(self, s: Lanes) -> Lanes:
        """Return t at the positions `s`, model units."""
        return self._entry + s


class _Space:
    """The path of a packet through contracted space: `player.march.contracted.ContractedPath` for LANES rays.
    Its methods are those of `_Box`."""

    def __init__(self, b: Any, packet: Any, steps: SpaceSteps) -> None:
        rows = [load(b, packet, LONG(row * LANES)) for row in range(SPACE_ROWS)]
        self._p, self._wd = rows[:3], rows[3:6]
        self._cos0, self._sin0, self._width, self._length, self._t_nearest = rows[6:]
        self._middles, self._ends, self._step = steps.middles, steps.ends, splat(b, steps.step)
        self._angles = [b.gep(steps.angles, [b.mul(steps.n_sizes, LONG(row))]) for row in range(3)]
        self._one = [splat(b, b.load(b.gep(row, [LONG(1)]))) for row in self._angles]
        self._end = splat(b, b.trunc(steps.n_steps, INT))
        self._fastest, self._cells = splat(b, steps.fastest), splat(b, steps.cells)
        zero = self._cos0.like(0.0)
        self._placed = [Variable(zero) for _ in range(2)]  # cos and sin of phi of the samples placed last
        self._of_size = [Variable(row) for row in self._one]  # their `angles`

    def first(self) -> Lanes:
        return self._end.like(0)

    def place(self, i: Lanes, active: Lanes) -> tuple[Lanes, Lanes, Three]:
        active = active & (i < self._end)
        s = (i.to_float() + 0.5) * self._step
        placed = self._turned(*_pairs(self._middles, i, active))
        for variable, value in zip((*self._placed, *self._of_size), (*placed, *self._one), strict=True):
            variable.set(value)
        return s, active & (s < self._length), self._on_grid(*placed)

    def place_group(self, i: Lanes, size: Lanes, where: Lanes) -> tuple[Lanes, Lanes, Three]:
        number = i + (size >> 1) - 1
        known = where & (number < self._end)
        s = (number + 1).to_float() * self._step
        placed = self._turned(*_pairs(self._ends, number, known))
        angles = (gather(row, size, 4, where).as_float() for row in self._angles)
        for variable, value in zip((*self._placed, *self._of_size), (*placed, *angles), strict=True):
            variable.set(choose(where, value, variable.get()))
        return s, known & (s < self._length), self._on_grid(*placed)

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
        cos, sin = (variable.get() for variable in self._placed)
        cos_half, sin_half, sin_angle = (variable.get() for variable in self._of_size)
        a, b = cos * cos_half, sin * sin_half
        below = (a + b).most(float(MIN_COS)) * (a - b).most(float(MIN_COS))
        return self._width * sin_angle / below

    def at(self, s: Lanes) -> Three:
        sin, cos = s.sin_cos()
        return self._on_grid(*self._turned(cos, sin))

    def distance(self, s: Lanes) -> Lanes:
        sin_s, cos_s = s.sin_cos()
        cos, sin = self._turned(cos_s, sin_s)
        return self._t_nearest + self._width * sin / cos.most(float(MIN_COS))

    def _turned(self, cos_s: Lanes, sin_s: Lanes) -> tuple[Lanes, Lanes]:
        """Return cos and sin of phi, from those of s."""
        return self._cos0 * cos_s - self._sin0 * sin_s, self._sin0 * cos_s + self._cos0 * sin_s

    def _on_grid(self, cos: Lanes, sin: Lanes) -> Three:
        v = [cos * p + sin * wd for p, wd in zip(self._p, self._wd, strict=True)]
        q = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).call("sqrt")
        scale = choose(q <= cos, 1.0 / cos, (2.0 - cos / q) / q) * self._cells
        middle = self._cells * 2.0
        x, y, z = (axis * scale + middle for axis in v)
        return x, y, z


def _pairs(table: Any, index: Lanes, where: Lanes) -> tuple[Lanes, Lanes]:
    """Load the two float32 in row `index` of a table, for the lanes that are true in `where`."""
    one, other = gather(table, index, 8, where, LONG).halves()
    return one.as_float(), other.as_float()


def _path(context: Any, b: Any, kinds: Any, steps: Any, packets: Any, number: Any) -> _Box | _Space:
    """Make the path of the packet `number`; the type of `steps` tells whether it is through a box."""
    common = unpacked(context, b, kinds[0], steps)
    n_rows = BOX_ROWS if isinstance(common, BoxSteps) else SPACE_ROWS
    packet = b.gep(address(context, b, kinds[1], packets), [b.mul(number, LONG(n_rows * LANES))])
    return _Box(b, packet, common) if isinstance(common, BoxSteps) else _Space(b, packet, common)


def brick_number(cells: Sequence[Lanes], n_per_axis: Lanes) -> Lanes:
    """Compute the same as `player.asset.grid.brick_number`."""
    x, y, z = (cell >> 3 for cell in cells)
    return (x * n_per_axis + y) * n_per_axis + z


def corner_number(bricks: Lanes, cells: Sequence[Lanes]) -> Lanes:
    """Compute the same as `player.asset.grid.corner_number`, in 64 bits; no number of `bricks` may be below
    0."""
    x, y, z = (cell & 7 for cell in cells)
    return bricks.wide() * 729 + (x * 81 + y * 9 + z).wide()


def _collect(
    b: Any, grid: Lookup, path: _Box | _Space, samples: Any, pitch: Any, out: Any, ways: bool
) -> Any:
    """March a packet. Write s to `samples`, weights `pitch` numbers behind s and, with `ways`, the lengths
    that samples stand for `pitch` numbers behind the weights. Write the SUMS results of each ray to `out`.
    Returns the number of rows of samples written."""
    resolution, n_per_axis = (splat(b, b.trunc(n, INT)) for n in (grid.resolution, grid.n_per_axis))
    low, slope = splat(b, grid.density_low), splat(b, grid.density_slope)
    last, zero, first = (resolution - 1).to_float(), low.like(0.0), path.first()
    i, taken, active = Variable(first), Variable(first.like(0)), Variable(first >= 0)
    tau, trans, n_weights = Variable(zero), Variable(zero.like(1.0)), Variable(zero)
    total, moment = _Sum(zero), _Sum(zero)
    least_coarse = splat(b, b.trunc(grid.least_coarse, INT))
    multiple = 0 - splat(b, b.trunc(grid.most_steps, INT))
    one, there = multiple.like(1), Variable(multiple.like(0))
    opaque_depth = splat(b, grid.opaque_depth)
    closing = opaque_depth < float(MAX_TAU)  # whether the sample that passes it counts as opaque

    def look_up(g: Three, where: Lanes) -> tuple[list[Lanes], Lanes]:
        """Return cells of the finest level, and the table's entries for them."""
        cell = [x.most(0.0).least(last).to_int() for x in g]
        return cell, gather(grid.table, brick_number(cell, n_per_axis), 4, where)

    n_rows = cgutils.alloca_once_value(b, LONG(0))
    with while_any(b, active):
        now = i.get()
        s, inside, g = path.place(now, active.get())
        cell, entry = look_up(g, inside)
        empty = inside & (entry < 0)
        busy = inside & (entry > -1)
        i.set(now + 1)
        active.set(inside)
        with b.if_then(empty.any()):
            bricks = (cell[0] >> 3, cell[1] >> 3, cell[2] >> 3)
            there.set(path.jump(now, g, bricks, (-entry & MAX_DISTANCE) - 1))
            i.set(choose(empty, (there.get() & multiple).most(now + 1), now + 1))
        at = _At(s, entry, busy, g, cell)
        level = choose(empty, -entry >> DISTANCE_BITS, entry & 7)
        coarse = inside & (level >= choose(empty, one, least_coarse))
        with b.if_then(coarse.any()):
            size = gather(grid.level_steps, level, 4, coarse)
            size = choose(now > 0, size.least(now & (0 - now)), size)  # now & -now: the lowest bit of now
            after = now + size
            i.set(choose(coarse & (busy | (after > i.get())), after, i.get()))
            # a group that begins in a dead brick may have its middle in a live cell, unless that is jumped
            # over
            grouped = coarse & (size > 1) & (busy | (after > there.get()))
            with b.if_then(grouped.any()):
                s, reached, g = path.place_group(now, size, grouped)
                cell, entry = look_up(g, reached)
                at.move(grouped, s, entry, reached & (entry > -1), g, cell)
            at.to_own_cells()
        s, entry, busy, g, cell = at.get()
        with b.if_then(busy.any()):  # a grid without a slot has nothing to read
            slot, within = entry >> 3, [c & 7 for c in cell]
            word = gather(grid.live, (slot << 4) + (within[0] << 1) + (within[1] >> 2), 4, busy)
            bit = ((within[1] & 3) << 3) + within[2]
            lit = Lanes(b, b.lshr(word.value, bit.value)) & 1
            live = lit.is_not(0)
            with b.if_then(live.any()):
                f = [x - c.to_float() for x, c in zip(g, cell, strict=True)]
                code = _trilinear(grid.density, corner_number(slot, cell), f, live)
                way = path.way()
                optical = (low + slope * code).exp() * way
                optical = choose(live, optical, zero)
                before = trans.get()
                depth = tau.get() + optical
                behind = (-depth).exp()
                series = 1.0 - optical * (1 / 2 - optical * (1 / 6 - optical * (1 / 24)))
                weight = choose(optical > 0.1, before - behind, before * optical * series)
                last = live & (depth > opaque_depth)
                weight = choose(last & closing, before, weight)
                depth = choose(last & closing, zero.like(float("inf")), depth)
                counts = live & (weight > 0)
                weight = choose(counts, weight, zero)
                tau.set(depth)
                trans.set(choose(live, behind, before))
                taken.set(taken.get() + lit)
                n_weights.set(choose(counts, n_weights.get() + 1, n_weights.get()))
                total.add(weight, counts)
                moment.add(weight * s, counts)
                active.set(inside & ~last)
                row = b.load(n_rows)
                place = b.mul(row, LONG(LANES))
                store(samples, place, s)
                store(samples, b.add(place, pitch), weight)
                if ways:
                    store(samples, b.add(place, b.add(pitch, pitch)), way)
                b.store(b.add(row, LONG(1)), n_rows)
    depth = path.distance(moment.get() / total.get())
    for row, values in (
        (TAU, tau.get()),
        (N_SAMPLES, taken.get().to_float()),
        (N_WEIGHTS, n_weights.get()),
        (TOTAL, total.get()),
        (DEPTH, depth),
    ):
        store(out, LONG(row * LANES), values)
    return b.load(n_rows)


class _At:
    """The positions of a packet's samples: s, the table's entry, whether there is a brick, grid coordinates
    and cell. Samples in bricks of coarser levels are moved to cells of those levels."""

    def __init__(self, s: Lanes, entry: Lanes, busy: Lanes, g: Three, cell: list[Lanes]) -> None:
        self._all = [Variable(value) for value in (s, entry, busy, *g, *cell)]

    def move(self, where: Lanes, s: Lanes, entry: Lanes, busy: Lanes, g: Three, cell: list[Lanes]) -> None:
        """Replace the values of the lanes that are true in `where`."""
        for variable, value in zip(self._all, (s, entry, busy, *g, *cell), strict=True):
            variable.set(choose(where, value, variable.get()))

    def to_own_cells(self) -> None:
        """Convert coordinates and cells from the finest level to that of each sample's brick."""
        _, entry, busy, *_ = (variable.get() for variable in self._all)
        level = choose(busy, entry & 7, 0)
        width = ((127 - level) << 23).as_float()
        for x, cell in zip(self._all[3:6], self._all[6:], strict=True):
            x.set(x.get() * width)
            cell.set(cell.get() >> level)

    def get(self) -> tuple[Lanes, Lanes, Lanes, list[Lanes], list[Lanes]]:
        s, entry, busy, *rest = (variable.get() for variable in self._all)
        return s, entry, busy, rest[:3], rest[3:]


class _Sum:
    """A compensated sum (Kahan) of many numbers, exact to the rounding of the last addition."""

    def __init__(self, zero: Lanes) -> None:
        self._sum, self._lost = Variable(zero), Variable(zero)

    def add(self, number: Lanes, where: Lanes) -> None:
        """Add the numbers of the lanes that are true in `where`. The other lanes are not touched: adding 0 to
        them would change their compensation, and with it the last bit of their sums. The sum of a ray must
        not depend on the rays beside it."""
        missing = number - self._lost.get()
        total = self._sum.get() + missing
        self._lost.set(choose(where, (total - self._sum.get()) - missing, self._lost.get()))
        self._sum.set(choose(where, total, self._sum.get()))

    def get(self) -> Lanes:
        return self._sum.get()


def _trilinear(density: Any, at: Lanes, f: list[Lanes], where: Lanes) -> Lanes:
    """Interpolate codes in cells trilinearly: along z, then y, then x."""

    def along_z(offset: int) -> Lanes:
        pair = gather(density, at, 1, where, offset=offset)
        low, high = (pair & 255).to_float(), ((pair >> 8) & 255).to_float()
        return low + (high - low) * f[2]

    c00, c01, c10, c11 = (along_z(offset) for offset in (0, 9, 81, 90))
    c0, c1 = c00 + (c01 - c00) * f[1], c10 + (c11 - c10) * f[1]
    return c0 + (c1 - c0) * f[0]


def _marching(ways: bool) -> Any:
    """Make the intrinsic `march_packet` or, with `ways`, `march_packet_ways`."""

    def typed(_: Any, lookup: Any, steps: Any, packets: Any, number: Any, samples: Any, out: Any) -> Any:

        def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
            kinds = signature.args
            grid = unpacked(context, b, kinds[0], arguments[0])
            path = _path(context, b, kinds[1:3], *arguments[1:4])
            places, found = (address(context, b, kinds[n], arguments[n]) for n in (4, 5))
            n_rows = 3 if ways else 2
            pitch = b.udiv(context.make_array(samples)(context, b, arguments[4]).nitems, LONG(n_rows))
            return _collect(b, grid, path, places, pitch, found, ways)

        return types.int64(lookup, steps, packets, types.intp, samples, out), generate

    return intrinsic(typed)


march_packet: Any = _marching(ways=False)
"""march_packet(lookup: Lookup, steps: BoxSteps or SpaceSteps, packets [n_packets, BOX_ROWS or SPACE_ROWS,
LANES] float32, number, samples [2, n, LANES] float32, out [SUMS, LANES] float32): march the packet `number`;
returns the number of rows of `samples` written.

`samples` gets s and weights, and must have room for the most samples that a ray can have. `out` gets the
results of each ray.
"""
march_packet_ways: Any = _marching(ways=True)
"""`march_packet` with `samples` [3, n, LANES]: behind the weights, it gets the length of ray, model units,
that each sample stands for."""


def _place_fetches(
    _: Any, steps: Any, packets: Any, number: Any, table: Any, first: Any, places: Any, weights: Any
) -> Any:

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        kinds = signature.args
        path = _path(context, b, kinds[:2], *arguments[:3])
        of_s, at, weight_at = (address(context, b, kinds[n], arguments[n]) for n in (3, 5, 6))
        s, weight = load(b, of_s, arguments[4]), load(b, weight_at, LONG(0))
        known = s >= 0  # NaN is not
        store(weight_at, LONG(0), choose(known, weight, 0.0))
        for axis, g in enumerate(path.at(choose(known, s, 0.0))):
            store(at, LONG(axis * LANES), g)
        return context.get_dummy_value()

    arrays = steps, packets, types.intp, table, types.intp, places, weights
    return types.void(*arrays), generate


place_fetches: Any = intrinsic(_place_fetches)
"""place_fetches(steps, packets, number, table float32, first, places [3, LANES] float32, weights [LANES]
float32): write to `places` the grid coordinates of LANES positions on the rays of the packet `number`. Their
s are in `table` from the index `first` on. Where s is NaN the weight becomes 0.
"""
