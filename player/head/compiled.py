"""A head in 8 bits, compiled by numba: the same graph that onnxruntime runs, computed in blocks of pixels
whose numbers stay in cache.

A head as `exporters.head.onnx_head` writes it is a dozen small matrix products, each with an activation
behind it. onnxruntime makes a pass over memory for every operation. Here all operations are done on one block
of pixels before the next (`player.head.dense_tiles`, `player.head.activations`), which takes four fifths of
the time of onnxruntime.
"""

from __future__ import annotations

import numpy as np

from player.compiling import compiled
from player.head.activations import (
    GELU,
    HARD_SWISH,
    gelu_lanes,
    hard_swish_lanes,
    quantize_lanes,
    round_lanes,
    sigmoid_lanes,
)
from player.head.dense_tiles import (
    LANES,
    MOST_BYTES,
    ROWS,
    WIDTH,
    add_lanes,
    dense_bytes_narrow_tile,
    dense_bytes_tile,
    dense_narrow_tile,
    dense_tile,
    multiply_lanes,
    repeat_lanes,
)
from player.head.program import (
    ADD,
    BLOCK,
    DENSE,
    DENSE_BYTES,
    MULTIPLY,
    QUAD,
    QUANTIZE,
    REPEAT,
    ROUND,
    Program,
)
from player.scratch import check_scratch, scratch


class CompiledHead:
    """A head's program, ready to run. May be called from several threads at a time."""

    def __init__(self, program: Program) -> None:
        self._program = program
        values = program.features, program.dirs, program.rgb
        self._places = tuple(v.place for v in values), tuple(v.pitch for v in values)

    def __call__(self, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """Compute the colours of pixels; arguments and result are those of `player.head.head.Head`."""
        p = self._program
        n_channels = p.features.width
        assert features.shape == (len(dirs), n_channels) and dirs.shape[1:] == (3,)
        rgb = np.empty(-(-3 * len(features) // LANES) * LANES, np.float32)
        memory, codes = scratch(p.n_floats, np.float32, 0), scratch(p.n_bytes, np.uint8, 0)
        inputs = (np.ascontiguousarray(a, np.float32) for a in (features, dirs))
        _run(p.steps, p.weights, (p.packed, p.starts), p.pairs, memory, codes, *inputs, rgb, self._places)
        check_scratch(memory, codes)
        return rgb[: 3 * len(features)].reshape(-1, 3)


@compiled
def _run(steps, weights, integers, pairs, memory, codes, features, dirs, rgb, places):
    at, pitch = places
    for begin in range(0, len(features), BLOCK):
        n = min(BLOCK, len(features) - begin)
        _fill(memory, at[0], pitch[0], features, begin, n)
        _fill(memory, at[1], pitch[1], dirs, begin, n)
        for i in range(len(steps)):
            step = steps[i]
            if step.kind == DENSE:
                _dense(memory, weights, step, n)
            elif step.kind == DENSE_BYTES:
                _dense_bytes(codes, memory, integers[0], integers[1], weights, step, n)
            elif step.kind == MULTIPLY:
                _multiply(memory, step, n)
            elif step.kind == ADD:
                _add(memory, step, n)
            elif step.kind == REPEAT:
                _repeat(memory, step, n)
            elif step.kind == QUANTIZE:
                _quantize(codes, memory, weights, step, n)
            elif step.kind == ROUND:
                _round(memory, weights, step, n)
            else:
                _monomials(memory, pairs, step, n)
        for row in range(n):
            for c in range(3):
                rgb[3 * (begin + row) + c] = memory[at[2] + row * pitch[2] + c]
    rgb[3 * len(features) :] = np.float32(0.0)
    for i in range(0, len(rgb), LANES):
        sigmoid_lanes(rgb, i)


@compiled
def _fill(memory, at, pitch, rows, begin, n):
    for row in range(n):
        for c in range(rows.shape[1]):
            memory[at + row * pitch + c] = rows[begin + row, c]


@compiled
def _dense(memory, weights, step, n):
    """Compute one layer for n pixels, tile by tile; what a tile has beyond n is written and never read."""
    x, x_pitch, w, start, start_pitch = step.x, step.x_pitch, step.w, step.start, step.start_pitch
    in_memory, scale, out, pitch, depth = step.starts_in_memory, step.scale, step.out, step.pitch, step.depth
    for first in range(0, pitch, WIDTH):
        for row in range(0, n, ROWS):
            rows = x + row * x_pitch, x_pitch
            starts = start + first + row * start_pitch, start_pitch, in_memory
            outputs = out + first + row * pitch, pitch
            if first + WIDTH <= pitch:
                dense_tile(memory, weights, rows, (w + first, pitch), starts, scale + first, outputs, depth)
            else:
                dense_narrow_tile(
                    memory, weights, rows, (w + first, pitch), starts, scale + first, outputs, depth
                )
    _activate(memory, out, n * pitch, step.activation)


@compiled
def _dense_bytes(codes, memory, packed, starts, weights, step, n):
    """Compute one layer for n pixels, tile by tile, from inputs and weights that are codes in bytes."""
    x, w, start, scale, out, pitch = step.x, step.w, step.start, step.scale, step.out, step.pitch
    depth = step.depth
    tables = packed, starts, weights
    for first in range(0, pitch, WIDTH):
        tile, places = w + first * QUAD * depth, (start + first, scale + first)
        for row in range(0, n, ROWS):
            outputs = out + first + row * pitch, pitch
            if first + WIDTH <= pitch:
                dense_bytes_tile(codes, memory, tables, x + row * MOST_BYTES, tile, places, outputs, depth)
            else:
                dense_bytes_narrow_tile(
                    codes, memory, tables, x + row * MOST_BYTES, tile, places, outputs, depth
                )
    _activate(memory, out, n * pitch, step.activation)


@compiled
def _activate(memory, at, n, kind):
    if kind == GELU:
        for i in range(at, at + n, LANES):
            gelu_lanes(memory, i)
    elif kind == HARD_SWISH:
        for i in range(at, at + n, LANES):
            hard_swish_lanes(memory, i)


@compiled
def _multiply(memory, step, n):
    x, x_pitch, out, pitch = step.x, step.x_pitch, step.out, step.pitch
    for _ in range(n):
        k = 0
        for i in range(0, pitch, LANES):
            multiply_lanes(memory, out + i, out + i, x + k)
            k = k + LANES if k + LANES < x_pitch else 0
        x, out = x + x_pitch, out + pitch


@compiled
def _repeat(memory, step, n):
    """Write each number several times. Whole vectors of copies are written; the next number overwrites the
    excess."""
    x, out = step.x, step.out
    for _ in range(n):
        for i in range(step.depth):
            for k in range(0, step.copies, LANES):
                repeat_lanes(memory, out + i * step.copies + k, x + i)
        x, out = x + step.x_pitch, out + step.pitch


@compiled
def _add(memory, step, n):
    for i in range(0, n * step.pitch, LANES):
        add_lanes(memory, step.out + i, step.out + i, step.x + i)
    _activate(memory, step.out, n * step.pitch, step.activation)


@compiled
def _monomials(memory, pairs, step, n):
    """Compute the first monomial for all pixels, then the second, and so on. So none is read just after it is
    written, which would make each product wait for the one before."""
    dirs_pitch, pitch = step.x_pitch, step.pitch
    for i in range(len(pairs)):
        parent, axis, out = step.out + pairs[i, 0], step.x + pairs[i, 1], step.out + i
        for row in range(n):
            value = memory[axis + row * dirs_pitch]
            if parent >= step.out:
                value *= memory[parent + row * pitch]
            memory[out + row * pitch] = value


@compiled
def _quantize(codes, memory, weights, step, n):
    x, pitch, zero, per_step, out = step.x, step.x_pitch, step.zero, weights[step.scale], step.out
    for _ in range(n):
        for i in range(0, pitch, LANES):
            quantize_lanes(codes, memory, out + i, x + i, zero, per_step)
        x, out = x + pitch, out + MOST_BYTES


@compiled
def _round(memory, weights, step, n):
    x, zero, per_step, out = step.x, step.zero, weights[step.scale], step.out
    for i in range(0, n * step.pitch, LANES):
        round_lanes(memory, out + i, x + i, zero, per_step)
