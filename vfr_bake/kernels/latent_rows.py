"""Interpolation of rows of latent features, and their moves along a gradient, with CHANNELS channels at a
time in registers.

The compiler does not vectorise a loop over the channels of a row: it cannot know that the memory which is
written does not overlap the memory which is read, and 16 channels are fewer than it would unroll. Letters as
in `vfr_bake.kernels.stored_features`. Only compiled code imports this module.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from player.compiled.lanes import INT, LANES, LONG, SHORT, Lanes, address, load, splat, store, vector

CHANNELS = LANES
"""Number of channels processed at a time. If fewer are left, what follows them in memory is read as well."""
PARTS_BITS = 8
PARTS = 1 << PARTS_BITS
"""Number of parts in a code: a latent feature is stored as a whole number of parts."""
LARGEST_LATENT = 127 * PARTS
GOLDEN = 0x9E3779B9
"""2^32 divided by the golden ratio: its multiples modulo 2^32 are spread evenly."""


def _table(context: Any, builder: Any, kind: Any, array: Any) -> tuple[Any, Any]:
    """Return the address of a two-dimensional array's first number, and its number of columns."""
    found = context.make_array(kind)(context, builder, array)
    return found.data, cgutils.unpack_tuple(builder, found.shape)[1]


def _interpolate_row(_: Any, latent: Any, rows: Any, shares: Any, fetch: Any, first: Any, out: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        latents, n_channels = _table(context, builder, latent, arguments[0])
        of_rows = address(context, builder, rows, arguments[1])
        of_shares = address(context, builder, shares, arguments[2])
        fetch, first = arguments[3:5]
        to, n_stored = _table(context, builder, out, arguments[5])
        terms = []
        for corner in range(8):
            number = builder.add(builder.mul(fetch, LONG(8)), LONG(corner))
            row = builder.sext(builder.load(builder.gep(of_rows, [number])), LONG)
            begin = builder.add(builder.mul(row, n_channels), first)
            codes = (load(builder, latents, begin, SHORT) + (PARTS >> 1)) >> PARTS_BITS
            share = builder.load(builder.gep(of_shares, [number]))
            terms.append(codes.to_float() * splat(builder, share))
        while len(terms) > 1:
            terms = [a + b for a, b in zip(terms[::2], terms[1::2], strict=True)]
        store(to, builder.add(builder.mul(fetch, n_stored), first), terms[0])
        return context.get_dummy_value()

    return types.void(latent, rows, shares, types.intp, types.intp, out), generate


interpolate_row: Any = intrinsic(_interpolate_row)
"""interpolate_row(latent [n_vertices, n_channels] int16, rows [n, 8] int32, shares [n, 8] float32, fetch,
first, out [n, n_stored] float32): interpolate the rounded codes around `fetch` with its shares, and write
CHANNELS channels, from `first` on, to `out[fetch]`.

CHANNELS values are read and written whatever n_channels is, so that much memory must be there. Values that
are written beyond n_channels have no meaning.
"""


def _move_row(
    _: Any, latent: Any, row: Any, first: Any, length: Any, gradient: Any, ray: Any, random: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        latents, n_channels = _table(context, builder, latent, arguments[0])
        row, first, length = arguments[1:4]
        slopes, n_stored = _table(context, builder, gradient, arguments[4])
        ray, random = arguments[5:]
        place = builder.add(builder.mul(row, n_channels), first)
        slope = load(builder, slopes, builder.add(builder.mul(ray, n_stored), first))
        moved = load(builder, latents, place, SHORT).to_float() - splat(builder, length) * slope
        moved = moved.most(-LARGEST_LATENT).least(LARGEST_LATENT)
        counted = Lanes(builder, ir.Constant(vector(INT), list(range(CHANNELS))))
        channel = splat(builder, builder.trunc(first, INT)) + counted
        mixed = splat(builder, random) + channel * GOLDEN
        part_of_one = ((mixed >> 8) & 0xFFFFFF).to_float() * 2.0**-24
        whole = (moved + part_of_one).call("floor").to_int()
        there = channel < splat(builder, builder.trunc(n_channels, INT))
        to = builder.bitcast(builder.gep(latents, [place]), ir.PointerType(vector(SHORT)))
        values = [builder.trunc(whole.value, vector(SHORT)), to, INT(2), there.value]
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in values])
        name = f"llvm.masked.store.v{CHANNELS}i16.p0"
        builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)
        return context.get_dummy_value()

    arrays = (latent, types.intp, types.intp, types.float32, gradient, types.intp, types.uint32)
    return types.void(*arrays), generate


move_row: Any = intrinsic(_move_row)
"""move_row(latent [n_vertices, n_channels] int16, row, first, length, gradient [n, n_stored] float32, ray,
random uint32): move `latent[row]` by -`length` `gradient[ray]`, CHANNELS channels from `first` on. The number
`random` decides how a move is rounded: 3.25 parts of a code become 4 in a quarter of all cases, and 3 in the
others.

Latents stay within +-LARGEST_LATENT. CHANNELS values are read whatever n_channels is: they must be there.
"""
