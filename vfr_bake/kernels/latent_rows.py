"""Rows of latent features in registers, CHANNELS at a time: interpolated, and moved along a gradient.

A loop over the channels of a row is not vectorised by the compiler, which cannot know that what is written
lies elsewhere than what is read, and sixteen are fewer than it would unroll. Letters as in
`vfr_bake.kernels.stored_features`. Compiled code alone imports this.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from player.compiled.lanes import FLOAT, INT, LONG

CHANNELS = 16
"""Channels at a time; fewer are read together with what follows them in memory."""
PARTS_BITS = 8
PARTS = 1 << PARTS_BITS
"""Parts of a code that a latent feature counts."""
LARGEST_LATENT = 127 * PARTS
GOLDEN = 0x9E3779B9
"""The golden ratio's part of 2^32: its multiples, modulo that, are spread evenly."""

_SHORT = ir.IntType(16)
_SHORTS, _INTS, _FLOATS, _BITS = (
    ir.VectorType(kind, CHANNELS) for kind in (_SHORT, INT, FLOAT, ir.IntType(1))
)
_FIRST_LANE = ir.Constant(_INTS, [0] * CHANNELS)


def _splat(builder: Any, scalar: Any, kind: ir.VectorType) -> Any:
    nothing = ir.Constant(kind, ir.Undefined)
    return builder.shuffle_vector(builder.insert_element(nothing, scalar, INT(0)), nothing, _FIRST_LANE)


def _base(context: Any, builder: Any, kind: Any, array: Any) -> tuple[Any, Any]:
    """Where the numbers of a two-dimensional array begin, and how many columns it has."""
    found = context.make_array(kind)(context, builder, array)
    return found.data, cgutils.unpack_tuple(builder, found.shape)[1]


def _place(builder: Any, base: Any, index: Any, kind: ir.VectorType) -> Any:
    return builder.bitcast(builder.gep(base, [index]), ir.PointerType(kind))


def _called(builder: Any, name: str, result: Any, *arguments: Any) -> Any:
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


def _interpolate_row(_: Any, latent: Any, rows: Any, shares: Any, fetch: Any, first: Any, out: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        latents, n_channels = _base(context, builder, latent, arguments[0])
        of_rows, _ = _base(context, builder, rows, arguments[1])
        of_shares, _ = _base(context, builder, shares, arguments[2])
        fetch, first = arguments[3:5]
        to, n_stored = _base(context, builder, out, arguments[5])
        half = ir.Constant(_SHORTS, [PARTS >> 1] * CHANNELS)
        bits = ir.Constant(_SHORTS, [PARTS_BITS] * CHANNELS)
        terms = []
        for corner in range(8):
            number = builder.add(builder.mul(fetch, LONG(8)), LONG(corner))
            row = builder.sext(builder.load(builder.gep(of_rows, [number])), LONG)
            begin = builder.add(builder.mul(row, n_channels), first)
            parts = builder.load(_place(builder, latents, begin, _SHORTS), align=2)
            codes = builder.sitofp(builder.ashr(builder.add(parts, half), bits), _FLOATS)
            share = builder.load(builder.gep(of_shares, [number]))
            terms.append(builder.fmul(codes, _splat(builder, share, _FLOATS)))
        while len(terms) > 1:
            terms = [builder.fadd(a, b) for a, b in zip(terms[::2], terms[1::2], strict=True)]
        begin = builder.add(builder.mul(fetch, n_stored), first)
        builder.store(terms[0], _place(builder, to, begin, _FLOATS), align=4)
        return context.get_dummy_value()

    return types.void(latent, rows, shares, types.intp, types.intp, out), generate


interpolate_row: Any = intrinsic(_interpolate_row)
"""interpolate_row(latent [n_vertices, n_channels] int16, rows [n, 8] int32, shares [n, 8] float32, fetch,
first, out [n, n_stored] float32): the rounded codes around `fetch`, weighted by its shares, into
`out[fetch]`, CHANNELS channels from `first` on.

CHANNELS values are read and written whatever n_channels: both have to be there. What is written beyond
n_channels is of no meaning.
"""


def _move_row(
    _: Any, latent: Any, row: Any, first: Any, length: Any, gradient: Any, ray: Any, random: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        latents, n_channels = _base(context, builder, latent, arguments[0])
        row, first, length = arguments[1:4]
        slopes, n_stored = _base(context, builder, gradient, arguments[4])
        ray, random = arguments[5:]
        place = _place(builder, latents, builder.add(builder.mul(row, n_channels), first), _SHORTS)
        parts = builder.sitofp(builder.load(place, align=2), _FLOATS)
        begin = builder.add(builder.mul(ray, n_stored), first)
        slope = builder.load(_place(builder, slopes, begin, _FLOATS), align=4)
        moved = builder.fsub(parts, builder.fmul(_splat(builder, length, _FLOATS), slope))
        for name, most in (("maxnum", -LARGEST_LATENT), ("minnum", LARGEST_LATENT)):
            limit = ir.Constant(_FLOATS, [float(most)] * CHANNELS)
            moved = _called(builder, f"llvm.{name}.v{CHANNELS}f32", _FLOATS, moved, limit)
        counted = ir.Constant(_INTS, list(range(CHANNELS)))
        channel = builder.add(_splat(builder, builder.trunc(first, INT), _INTS), counted)
        mixed = builder.mul(channel, ir.Constant(_INTS, [GOLDEN] * CHANNELS))
        mixed = builder.add(_splat(builder, random, _INTS), mixed)
        share = builder.uitofp(builder.lshr(mixed, ir.Constant(_INTS, [8] * CHANNELS)), _FLOATS)
        share = builder.fmul(share, ir.Constant(_FLOATS, [2.0**-24] * CHANNELS))
        moved = _called(builder, f"llvm.floor.v{CHANNELS}f32", _FLOATS, builder.fadd(moved, share))
        short = builder.trunc(builder.fptosi(moved, _INTS), _SHORTS)
        there = builder.icmp_signed("<", channel, _splat(builder, builder.trunc(n_channels, INT), _INTS))
        _called(builder, f"llvm.masked.store.v{CHANNELS}i16.p0", ir.VoidType(), short, place, INT(2), there)
        return context.get_dummy_value()

    arrays = (latent, types.intp, types.intp, types.float32, gradient, types.intp, types.uint32)
    return types.void(*arrays), generate


move_row: Any = intrinsic(_move_row)
"""move_row(latent [n_vertices, n_channels] int16, row, first, length, gradient [n, n_stored] float32, ray,
random uint32): move `latent[row]` by -`length` `gradient[ray]`, CHANNELS channels from `first` on. By the
number `random` a move of 3.25 parts of a code is one of 4 in a quarter of all cases, and else one of 3.

Latents stay within +-LARGEST_LATENT. CHANNELS values are read whatever n_channels: they have to be there.
"""
