"""Whether what compiled heads are made of computes what numpy does: tiles of layers in float32 and in 8 bits,
activations, roundings. `player.proof` asks; compiled code alone imports this."""

from __future__ import annotations

import math

import numpy as np

from player.compiling import compiled
from player.head.activations import gelu_lanes, quantize_lanes, sigmoid_lanes
from player.head.dense_tiles import (
    LANES,
    MOST_BYTES,
    MULTIPLIES_BYTES,
    QUAD,
    ROWS,
    WIDTH,
    dense_bytes_narrow_tile,
    dense_bytes_tile,
    dense_narrow_tile,
    dense_tile,
)

F32 = np.float32
DEPTH = 24
"""Inputs of the layer."""


def wrong() -> str | None:
    """What is wrong, in words; None if nothing is."""
    numbers = np.random.default_rng(0)
    x = numbers.uniform(-1, 1, (ROWS, DEPTH)).astype(F32)
    w = numbers.uniform(-1, 1, (DEPTH, WIDTH)).astype(F32)
    memory = np.zeros(x.size + ROWS * WIDTH, F32)
    memory[: x.size] = x.reshape(-1)
    weights = np.concatenate([w.reshape(-1), np.zeros(WIDTH, F32), np.full(WIDTH, 0.5, F32)])
    expected = 0.5 * x.astype(np.float64) @ w
    for tiles in (_floats, _narrow_floats):
        memory[x.size :] = 0
        tiles(memory, weights, DEPTH)
        if not np.allclose(memory[x.size :].reshape(ROWS, WIDTH), expected, rtol=0, atol=1e-5):
            return "a layer gives other sums than numpy"
    y = np.linspace(-6, 6, 4 * LANES, dtype=F32)
    gelu, sigmoid, codes = y.copy(), y.copy(), np.zeros(y.size, np.uint8)
    _follow(gelu, sigmoid, codes, y, F32(20))
    expected = y * np.array([0.5 * math.erfc(-value / math.sqrt(2)) for value in y])
    if not np.allclose(gelu, expected, rtol=0, atol=1e-5):
        return "gelu is another than numpy's"
    if not np.allclose(sigmoid, 1 / (1 + np.exp(-y.astype(np.float64))), rtol=0, atol=1e-5):
        return "the sigmoid is another than numpy's"
    if (codes != np.clip(np.rint(y * F32(20)) + 100, 0, 255)).any():
        return "codes are others than numpy's"
    return _wrong_bytes(numbers) if MULTIPLIES_BYTES else None


def _wrong_bytes(numbers: np.random.Generator) -> str | None:
    codes = np.zeros((ROWS, MOST_BYTES), np.uint8)
    codes[:, :DEPTH] = numbers.integers(0, 256, (ROWS, DEPTH))
    w = numbers.integers(-127, 128, (DEPTH, WIDTH)).astype(np.int8)
    codes[0], w[:, 0] = 255, 127
    packed = w.reshape(DEPTH // QUAD, QUAD, WIDTH // LANES, LANES).transpose(2, 0, 3, 1).reshape(-1)
    starts = numbers.integers(-1000, 1000, WIDTH).astype(np.int32)
    expected = (codes[:, :DEPTH].astype(np.int64) @ w + starts) * 0.5
    for tiles in (_bytes, _narrow_bytes):
        memory = np.zeros(ROWS * WIDTH, F32)
        tiles(codes.reshape(-1), memory, packed, starts, np.full(WIDTH, 0.5, F32), DEPTH // QUAD)
        if (memory.reshape(ROWS, WIDTH) != expected).any():
            return "products of bytes are others than numpy's"
    return None


@compiled
def _floats(memory, weights, depth):
    out, start = len(memory) - ROWS * WIDTH, depth * WIDTH
    dense_tile(
        memory, weights, (0, depth), (0, WIDTH), (start, 0, 0), start + WIDTH, (out, WIDTH), depth
    )  # fmt: skip


@compiled
def _narrow_floats(memory, weights, depth):
    out, start = len(memory) - ROWS * WIDTH, depth * WIDTH
    for first in range(0, WIDTH, LANES):
        dense_narrow_tile(
            memory, weights, (0, depth), (first, WIDTH), (start + first, 0, 0), start + WIDTH + first,
            (out + first, WIDTH), depth,
        )  # fmt: skip


@compiled
def _follow(gelu, sigmoid, codes, x, per_step):
    for i in range(0, len(x), LANES):
        gelu_lanes(gelu, i)
        sigmoid_lanes(sigmoid, i)
        quantize_lanes(codes, x, i, i, 100, per_step)


@compiled
def _bytes(codes, memory, packed, starts, scales, n_quads):
    dense_bytes_tile(codes, memory, (packed, starts, scales), 0, 0, (0, 0), (0, WIDTH), n_quads)


@compiled
def _narrow_bytes(codes, memory, packed, starts, scales, n_quads):
    for first in range(0, WIDTH, LANES):
        dense_bytes_narrow_tile(
            codes, memory, (packed, starts, scales), 0, first * QUAD * n_quads, (first, first),
            (first, WIDTH), n_quads,
        )  # fmt: skip
