"""The head, compiled by numba: the same graph that onnxruntime runs, in blocks whose numbers stay in cache.

A head as `exporters.head.onnx_head` writes it is a dozen small matrix products with a GELU behind each.
onnxruntime makes a pass over memory of every operation, and a third of its time goes into GELU alone; here
all operations are done on a block of pixels (`player.head.dense_tiles`, `player.head.activations`), in
float32 and in 8 bits.
"""

from __future__ import annotations

import numpy as np

from player.compiled.compiling import compiled
from player.compiled.scratch import check_scratch, scratch
from player.head.activations import (
    GELU,
    SIGMOID,
    gelu_lanes,
    quantize_lanes,
    round_lanes,
    sigmoid_lanes,
)
from player.head.dense_tiles import (
    LANES,
    MOST_BYTES,
    ROWS,
    WIDTH,
    dense_bytes_tile,
    dense_codes_tile,
    dense_tile,
    multiply_lanes,
)
from player.head.graph import HeadArrays
from player.head.program import (
    BLOCK,
    DENSE,
    DENSE_BYTES,
    DENSE_CODES,
    MULTIPLY,
    QUAD,
    QUANTIZE,
    ROUND,
    Program,
    program_of,
)


class CompiledHead:
    """A head's program and how to run it; may be called from several threads at a time."""

    def __init__(self, program: Program) -> None:
        self._program = program
        values = program.features, program.dirs, program.rgb
        self._places = tuple(v.place for v in values), tuple(v.pitch for v in values)

    def __call__(self, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """As `player.head.head.Head`."""
        p = self._program
        n_channels = p.features.width
        assert features.shape == (len(dirs), n_channels) and dirs.shape[1:] == (3,)
        rgb = np.empty((len(features), 3), np.float32)
        memory, codes = scratch(p.n_floats, np.float32, 0), scratch(p.n_bytes, np.uint8, 0)
        inputs = (np.ascontiguousarray(a, np.float32) for a in (features, dirs))
        _run(p.steps, p.weights, (p.packed, p.starts), p.pairs, memory, codes, *inputs, rgb, self._places)
        check_scratch(memory, codes)
        return rgb


def compile_head(head: HeadArrays) -> CompiledHead:
    """The head, ready to run."""
    return CompiledHead(program_of(head))


@compiled
def _run(steps, weights, integers, pairs, memory, codes, features, dirs, rgb, places):
    at, pitch = places
    for begin in range(0, len(features), BLOCK):
        n = min(BLOCK, len(features) - begin)
        _fill(memory, at[0], pitch[0], features, begin, n)
        _fill(memory, at[1], pitch[1], dirs, begin, n)
        for i in range(len(steps)):
            step = steps[i]
            if step[0] == DENSE:
                _dense(memory, weights, step, n)
            elif step[0] == DENSE_CODES:
                _dense_codes(memory, weights, step, n)
            elif step[0] == DENSE_BYTES:
                _dense_bytes(codes, memory, integers[0], integers[1], weights, step, n)
            elif step[0] == MULTIPLY:
                _multiply(memory, step[1], step[3], n * step[2])
            elif step[0] == QUANTIZE:
                _quantize(codes, memory, weights, step, n)
            elif step[0] == ROUND:
                _round(memory, weights, step, n * step[2])
            else:
                _monomials(memory, pairs, step, n)
        for row in range(n):
            for c in range(3):
                rgb[begin + row, c] = memory[at[2] + row * pitch[2] + c]


@compiled
def _multiply(memory, a, b, n):
    for i in range(0, n, LANES):
        multiply_lanes(memory, a + i, a + i, b + i)


@compiled
def _monomials(memory, pairs, step, n):
    dirs, pitch, out, out_pitch = step[1], step[2], step[8], step[9]
    for _ in range(n):
        for i in range(len(pairs)):
            parent, axis = pairs[i, 0], pairs[i, 1]
            value = memory[dirs + axis]
            memory[out + i] = value if parent < 0 else memory[out + parent] * value
        dirs, out = dirs + pitch, out + out_pitch


@compiled
def _quantize(codes, memory, weights, step, n):
    x, pitch, zero, per_step, out = step[1], step[2], step[4], weights[step[3]], step[8]
    for _ in range(n):
        for i in range(0, pitch, LANES):
            quantize_lanes(codes, memory, out + i, x + i, zero, per_step)
        x, out = x + pitch, out + MOST_BYTES


@compiled
def _round(memory, weights, step, n):
    out, x, zero, per_step = step[8], step[1], step[4], weights[step[3]]
    for i in range(0, n, LANES):
        round_lanes(memory, out + i, x + i, zero, per_step)


@compiled
def _fill(memory, at, pitch, rows, begin, n):
    for row in range(n):
        for c in range(rows.shape[1]):
            memory[at + row * pitch + c] = rows[begin + row, c]


@compiled
def _dense(memory, weights, step, n):
    """One layer of n pixels, tile by tile; what a tile has beyond n is written and never read."""
    x, x_pitch, w, w_pitch, start, start_pitch = step[1], step[2], step[3], step[4], step[5], step[6]
    out, pitch = step[8], step[9]
    for first in range(0, w_pitch, WIDTH):
        for row in range(0, n, ROWS):
            dense_tile(
                memory, weights, (x + row * x_pitch, x_pitch), (w + first, w_pitch),
                (start + first + row * start_pitch, start_pitch, step[7]),
                (out + first + row * pitch, pitch), step[10],
            )  # fmt: skip
    _activate(memory, out, n * pitch, step[11])


@compiled
def _activate(memory, at, n, kind):
    if kind == GELU:
        for i in range(at, at + n, LANES):
            gelu_lanes(memory, i)
    elif kind == SIGMOID:
        for i in range(at, at + n, LANES):
            sigmoid_lanes(memory, i)


@compiled
def _dense_codes(memory, weights, step, n):
    """The same of a layer in 8 bits whose codes are floats."""
    x, x_pitch, w, w_pitch, start, scale = step[1], step[2], step[3], step[4], step[5], step[7]
    out, pitch = step[8], step[9]
    for first in range(0, w_pitch, WIDTH):
        for row in range(0, n, ROWS):
            dense_codes_tile(
                memory, weights, (x + row * x_pitch, x_pitch), (w + first, w_pitch),
                (start + first, scale + first), (out + first + row * pitch, pitch), step[10],
            )  # fmt: skip
    _activate(memory, out, n * pitch, step[11])


@compiled
def _dense_bytes(codes, memory, packed, starts, weights, step, n):
    """The same of a layer in 8 bits."""
    x, w, start, scale, out, pitch = step[1], step[3], step[4], step[5], step[8], step[9]
    for first in range(0, pitch, WIDTH):
        for row in range(0, n, ROWS):
            dense_bytes_tile(
                codes, memory, (packed, starts, weights), x + row * MOST_BYTES,
                w + first * QUAD * step[10], (start + first, scale + first),
                (out + first + row * pitch, pitch), step[10],
            )  # fmt: skip
    _activate(memory, out, n * pitch, step[11])
