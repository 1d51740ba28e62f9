"""Tiles of dense layers, computed in registers. `player.head.compiled` puts them together.

A tile is ROWS pixels by two vectors of LANES outputs, as much as the processor's registers hold, or by one
vector at the end of a layer. Layers are in float32 or, where the processor multiplies bytes, in 8 bits: a
register holds four times as many of these. Only compiled code imports this module.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from player.compiled.lanes import (
    BYTE,
    FLOAT,
    INT,
    LANES,
    LONG,
    SHORT,
    Lanes,
    address,
    load,
    splat,
    store,
    vector,
)
from player.compiled.processor import multiplies_bytes, multiplies_shorts

ROWS = 12 if LANES == 16 else 6
"""Pixels of a tile. A processor has 32 registers of 16 numbers, or 16 of 8: beside the two vectors of sums
for each pixel, some registers are left for inputs and weights."""
WIDTH = 2 * LANES
"""Outputs of a tile of two vectors."""

QUAD = 4
"""Number of products of bytes that the processor adds up in one instruction."""
MOST_BYTES = 256
"""Most inputs of a layer in bytes, and the number of bytes from a pixel to the next. Since it is a constant,
the compiler needs no register for the address of each row."""
UNSCALED = -(1 << 40)
"""An index of scales that stands for no scales. It stays below 0 when the offset of a tile in its layer is
added."""
ADDS_QUADS = multiplies_bytes(QUAD * LANES)
"""Whether the processor adds up QUAD products of bytes in one instruction (VNNI): Intel's do since 2019,
AMD's since 2022."""
ADDS_PAIRS = not ADDS_QUADS and multiplies_shorts(QUAD * LANES)
"""Whether the processor adds up two products of bytes at a time, in 16 bits, as all with AVX2 do. That is
exact where the magnitudes of two neighbouring weights add up to `player.head.graph.PAIR_LIMIT` at most."""
MULTIPLIES_BYTES = ADDS_QUADS or ADDS_PAIRS
_DOT = f"llvm.x86.avx512.vpdpbusd.{32 * LANES}"
"""LLVM's name of the instruction that adds up QUADs. Its operands are words of QUAD bytes, as in LLVM up to
version 21; later versions convert them."""
_PAIRS, _QUADS = {
    8: ("llvm.x86.avx2.pmadd.ub.sw", "llvm.x86.avx2.pmadd.wd"),
    16: ("llvm.x86.avx512.pmaddubs.w.512", "llvm.x86.avx512.pmaddw.d.512"),
}[LANES]
"""LLVM's names of the instructions that multiply bytes and add up each two neighbouring products, and that do
the same to integers of 16 bits."""


def _dense(n_vectors: int) -> Any:

    def typed(
        _: Any, memory: Any, weights: Any, x: Any, w: Any, start: Any, scale: Any, out: Any, depth: Any
    ) -> Any:

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            here, there = (address(context, builder, signature.args[n], arguments[n]) for n in (0, 1))
            in_memory = builder.icmp_signed("!=", builder.extract_value(arguments[4], 2), LONG(0))
            first = builder.select(in_memory, here, there)
            start_at, start_pitch = _pair(builder, arguments[4])
            sums = _Sums(builder, FLOAT, n_vectors)
            for row in range(ROWS):
                at = builder.add(start_at, builder.mul(start_pitch, LONG(row)))
                for number in range(n_vectors):
                    sums.set(row, number, load(builder, first, builder.add(at, LONG(number * LANES))))
            _add_products(builder, sums, (here, arguments[2]), (there, arguments[3]), arguments[7])
            out, scale_at = _pair(builder, arguments[6]), arguments[5]
            with builder.if_else(builder.icmp_signed(">=", scale_at, LONG(0))) as (scaled, unscaled):
                with scaled:
                    sums.write(here, out, _scales(builder, there, scale_at, n_vectors))
                with unscaled:
                    sums.write(here, out)
            return context.get_dummy_value()

        long, two, three = types.int64, types.UniTuple(types.int64, 2), types.UniTuple(types.int64, 3)
        return types.void(memory, weights, two, two, three, long, two, long), generate

    return intrinsic(typed)


dense_tile: Any = _dense(2)
"""dense_tile(memory, weights, x, w, start, scale, out, depth): compute ROWS by WIDTH outputs of one layer.

`memory` and `weights` are flat float32. `x`, `w` and `out` are (index of the first number, numbers from row
to row), `w` in `weights`, the others in `memory`. `start`: (index of the first number that the sums begin
with, numbers from row to row, whether these are in `memory` rather than in `weights`). `scale`: index in
`weights` of WIDTH numbers that the sums are multiplied by, below 0 for none. `depth`: number of inputs of the
layer.

Inputs and weights may be 8-bit codes written as floats: sums below 2^24 are then exact, as those of
`dense_bytes_tile` are.
"""
dense_narrow_tile: Any = _dense(1)
"""Like `dense_tile`, for ROWS by LANES outputs."""


def _add_products(builder: Any, sums: _Sums, x: tuple[Any, Any], w: tuple[Any, Any], depth: Any) -> None:
    """Add to `sums` the products of the `depth` inputs of each row and their weights.

    `x` and `w` are (array, (index of the first number, numbers from row to row)).
    """
    x_rows = _rows(builder, x[0], *_pair(builder, x[1]))
    w_at, w_pitch = _pair(builder, w[1])
    with cgutils.for_range(builder, depth) as loop:
        at = builder.add(w_at, builder.mul(w_pitch, loop.index))
        columns = [load(builder, w[0], builder.add(at, LONG(n * LANES))) for n in range(sums.n_vectors)]
        for row in range(ROWS):
            value = splat(builder, builder.load(builder.gep(x_rows[row], [loop.index])))
            for number, column in enumerate(columns):
                sums.set(row, number, value.call("fma", column, sums.get(row, number)))


def _plus_products(total: Lanes, codes: Lanes, weights: Lanes) -> Lanes:
    """Return LANES sums, to each of which the products of QUAD codes (unsigned bytes) and as many weights
    (signed bytes) are added."""
    b, lanes = total.b, vector(INT)
    if ADDS_QUADS:
        dot = cgutils.get_or_insert_function(b.module, ir.FunctionType(lanes, [lanes] * 3), _DOT)
        return Lanes(b, b.call(dot, [total.value, codes.value, weights.value]))
    in_bytes, shorts = ir.VectorType(BYTE, QUAD * LANES), ir.VectorType(SHORT, 2 * LANES)
    pairs = cgutils.get_or_insert_function(b.module, ir.FunctionType(shorts, [in_bytes] * 2), _PAIRS)
    quads = cgutils.get_or_insert_function(b.module, ir.FunctionType(lanes, [shorts] * 2), _QUADS)
    twos = b.call(pairs, [b.bitcast(codes.value, in_bytes), b.bitcast(weights.value, in_bytes)])
    return total + Lanes(b, b.call(quads, [twos, ir.Constant(shorts, [1] * (2 * LANES))]))


def _dense_bytes(n_vectors: int) -> Any:

    def typed(
        _: Any, codes: Any, memory: Any, weights: Any, x: Any, w: Any, places: Any, out: Any, n: Any
    ) -> Any:
        packed, starts, scales = weights

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            if not MULTIPLIES_BYTES:  # no program has this step, and the compiler may lack the instruction
                return context.get_dummy_value()
            bytes_here, here = (address(context, builder, signature.args[n], arguments[n]) for n in (0, 1))
            parts = [builder.extract_value(arguments[2], index) for index in range(3)]
            packed_there, starts_there, scales_there = (
                address(context, builder, kind, part)
                for kind, part in zip((packed, starts, scales), parts, strict=True)
            )
            out, depth = _pair(builder, arguments[6]), arguments[7]
            start_at, scale_at = _pair(builder, arguments[5])
            sums = _Sums(builder, INT, n_vectors)
            for number in range(n_vectors):
                start = load(builder, starts_there, builder.add(start_at, LONG(number * LANES)), INT)
                for row in range(ROWS):
                    sums.set(row, number, start)
            quads = ir.PointerType(INT)
            x_rows = _rows(builder, bytes_here, arguments[3], LONG(MOST_BYTES))
            x_rows = [builder.bitcast(row, quads) for row in x_rows]
            words = builder.bitcast(builder.gep(packed_there, [arguments[4]]), quads)
            with cgutils.for_range(builder, depth) as loop:
                columns = []
                for number in range(n_vectors):
                    quad = builder.add(builder.mul(depth, LONG(number)), loop.index)
                    columns.append(load(builder, words, builder.mul(quad, LONG(LANES)), INT))
                for row in range(ROWS):
                    quad = splat(builder, builder.load(builder.gep(x_rows[row], [loop.index]), align=1))
                    for number, column in enumerate(columns):
                        sums.set(row, number, _plus_products(sums.get(row, number), quad, column))
            sums.write(here, out, _scales(builder, scales_there, scale_at, n_vectors))
            return context.get_dummy_value()

        long, two = types.int64, types.UniTuple(types.int64, 2)
        return types.void(codes, memory, weights, long, long, two, two, long), generate

    return intrinsic(typed)


dense_bytes_tile: Any = _dense_bytes(2)
"""dense_bytes_tile(codes, memory, weights, x, w, places, out, n_quads): compute ROWS by WIDTH outputs of a
layer of 8-bit codes. It computes nothing unless MULTIPLIES_BYTES.

`codes` are flat uint8, `memory` is flat float32. `weights` is (int8 codes, int32 that sums begin with,
float32 that sums are multiplied by). Its int8 codes have QUAD inputs of one output side by side, then those
of the next output, for LANES outputs; that n_quads times; then the next LANES outputs. `x`: index of the
first code of the first pixel; each next pixel is MOST_BYTES further on. `w`: index of the first code of the
tile's weights. `places`: (index of what the sums begin with, index of what they are multiplied by). `out`:
(index of the first output in `memory`, numbers from row to row).
"""
dense_bytes_narrow_tile: Any = _dense_bytes(1)
"""Like `dense_bytes_tile`, for ROWS by LANES outputs."""


def _combined(combine: Callable[[Lanes, Lanes], Lanes]) -> Any:

    def typed(_: Any, memory: Any, out: Any, a: Any, b: Any) -> Any:

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            array = address(context, builder, signature.args[0], arguments[0])
            one, other = (load(builder, array, at) for at in arguments[2:])
            store(array, arguments[1], combine(one, other))
            return context.get_dummy_value()

        return types.void(memory, types.int64, types.int64, types.int64), generate

    return intrinsic(typed)


multiply_lanes: Any = _combined(lambda a, b: a * b)
"""multiply_lanes(memory, out, a, b): write the products of LANES numbers at `a` and at `b` to `out`.

The compiler does not vectorise this by itself: it cannot know that the three do not overlap.
"""
add_lanes: Any = _combined(lambda a, b: a + b)
"""add_lanes(memory, out, a, b): the same with sums."""


def _repeat(_: Any, memory: Any, out: Any, x: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = address(context, builder, signature.args[0], arguments[0])
        store(array, arguments[1], splat(builder, builder.load(builder.gep(array, [arguments[2]]))))
        return context.get_dummy_value()

    return types.void(memory, types.int64, types.int64), generate


repeat_lanes: Any = intrinsic(_repeat)
"""repeat_lanes(memory, out, x): write the number at `x` to LANES places from `out` on."""


class _Sums:
    """The sums of a tile, ROWS by some vectors, which a loop adds to."""

    def __init__(self, builder: Any, element: Any, n_vectors: int) -> None:
        self.n_vectors = n_vectors
        self._builder = builder
        self._places = [
            [cgutils.alloca_once(builder, vector(element)) for _ in range(n_vectors)] for _ in range(ROWS)
        ]

    def get(self, row: int, number: int) -> Lanes:
        return Lanes(self._builder, self._builder.load(self._places[row][number]))

    def set(self, row: int, number: int, value: Lanes) -> None:
        self._builder.store(value.value, self._places[row][number])

    def write(self, array: Any, out: tuple[Any, Any], scales: list[Lanes] | None = None) -> None:
        """Write the sums to `array` row by row, multiplied by `scales`, one for each of a row's vectors.

        `out`: (index of the first number, numbers from row to row).
        """
        at, pitch = out
        for row in range(ROWS):
            start = self._builder.add(at, self._builder.mul(pitch, LONG(row)))
            for number in range(self.n_vectors):
                place = self._builder.add(start, LONG(number * LANES))
                total = self.get(row, number)
                store(array, place, total if scales is None else total.to_float() * scales[number])


def _pair(builder: Any, pair: Any) -> tuple[Any, Any]:
    return builder.extract_value(pair, 0), builder.extract_value(pair, 1)


def _scales(builder: Any, array: Any, at: Any, n_vectors: int) -> list[Lanes]:
    """Load vectors of numbers from the index `at` on."""
    return [load(builder, array, builder.add(at, LONG(number * LANES))) for number in range(n_vectors)]


def _rows(builder: Any, array: Any, at: Any, pitch: Any) -> list[Any]:
    """Return the addresses of ROWS rows, the first at the index `at`."""
    return [builder.gep(array, [builder.add(at, builder.mul(pitch, LONG(row)))]) for row in range(ROWS)]
