"""Check that the parts of compiled heads compute what numpy does: tiles of layers in float32 and in 8 bits,
activations, roundings. `player.proof` calls it. Only compiled code imports this module."""

from __future__ import annotations

import math

import numpy as np

from player.compiling import compiled
from player.head.activations import gelu_lanes, hard_swish_lanes, quantize_lanes, sigmoid_lanes
from player.head.dense_tiles import (
    ADDS_QUADS,
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
from player.head.graph import PAIR_LIMIT

F32 = np.float32
DEPTH = 24
"""Number of inputs of the layer that is checked."""


def wrong() -> str | None:
    """Describe in words what is wrong; None if nothing is."""
    numbers = np.random.default_rng(0)
    x = numbers.uniform(-1, 1, (ROWS, DEPTH)).astype(F32)
    w = numbers.uniform(-1, 1, (DEPTH, WIDTH)).astype(F32)
    memory = np.zeros(x.size + 2 * ROWS * WIDTH, F32)
    memory[: x.size] = x.reshape(-1)
    weights = np.concatenate([w.reshape(-1), np.zeros(WIDTH, F32), np.full(WIDTH, 0.5, F32)])
    _floats(memory, weights, DEPTH)
    expected = 0.5 * x.astype(np.float64) @ w
    if not np.allclose(memory[x.size :].reshape(2, ROWS, WIDTH), expected, rtol=0, atol=1e-5):
        return "a layer gives other sums than numpy"
    y = np.linspace(-6, 6, 4 * LANES, dtype=F32)
    gelu, swish, sigmoid, codes = y.copy(), y.copy(), y.copy(), np.zeros(y.size, np.uint8)
    _follow(gelu, swish, sigmoid, codes, y, F32(20))
    expected = y * np.array([0.5 * math.erfc(-value / math.sqrt(2)) for value in y])
    if not np.allclose(gelu, expected, rtol=0, atol=1e-5):
        return "gelu is another than numpy's"
    if not np.allclose(swish, y * np.clip(y / 6 + 0.5, 0, 1), rtol=0, atol=1e-5):
        return "the hard swish is another than numpy's"
    if not np.allclose(sigmoid, 1 / (1 + np.exp(-y.astype(np.float64))), rtol=0, atol=1e-5):
        return "the sigmoid is another than numpy's"
    if (codes != np.clip(np.rint(y * F32(20)) + 100, 0, 255)).any():
        return "codes are others than numpy's"
    return _wrong_bytes(numbers) if MULTIPLIES_BYTES else None


def _wrong_bytes(numbers: np.random.Generator) -> str | None:
    codes = np.zeros((ROWS, MOST_BYTES), np.uint8)
    codes[:, :DEPTH] = numbers.integers(0, 256, (ROWS, DEPTH))
    most = 127 if ADDS_QUADS else PAIR_LIMIT // 2
    w = numbers.integers(-most, most + 1, (DEPTH, WIDTH)).astype(np.int8)
    codes[0], w[:, 0] = 255, most
    packed = w.reshape(DEPTH // QUAD, QUAD, WIDTH // LANES, LANES).transpose(2, 0, 3, 1).reshape(-1)
    starts = numbers.integers(-1000, 1000, WIDTH).astype(np.int32)
    memory = np.zeros(2 * ROWS * WIDTH, F32)
    _bytes(codes.reshape(-1), memory, packed, starts, np.full(WIDTH, 0.5, F32), DEPTH // QUAD)
    expected = (codes[:, :DEPTH].astype(np.int64) @ w + starts) * 0.5
    right = (memory.reshape(2, ROWS, WIDTH) == expected).all()
    return None if right else "products of bytes are others than numpy's"


@compiled
def _floats(memory, weights, depth):
    """Compute a layer by a wide tile and, behind it in memory, once more by narrow tiles."""
    x, scales, wide = (0, depth), (depth + 1) * WIDTH, ROWS * depth
    narrow = wide + ROWS * WIDTH
    dense_tile(memory, weights, x, (0, WIDTH), (depth * WIDTH, 0, 0), scales, (wide, WIDTH), depth)
    for i in range(0, WIDTH, LANES):
        dense_narrow_tile(
            memory, weights, x, (i, WIDTH), (depth * WIDTH + i, 0, 0), scales + i, (narrow + i, WIDTH), depth
        )


@compiled
def _follow(gelu, swish, sigmoid, codes, x, per_step):
    for i in range(0, len(x), LANES):
        gelu_lanes(gelu, i)
        hard_swish_lanes(swish, i)
        sigmoid_lanes(sigmoid, i)
        quantize_lanes(codes, x, i, i, 100, per_step)


@compiled
def _bytes(codes, memory, packed, starts, scales, n_quads):
    """Compute a layer by a wide tile and, behind it in memory, once more by narrow tiles."""
    tables, narrow = (packed, starts, scales), ROWS * WIDTH
    dense_bytes_tile(codes, memory, tables, 0, 0, (0, 0), (0, WIDTH), n_quads)
    for i in range(0, WIDTH, LANES):
        dense_bytes_narrow_tile(
            codes, memory, tables, 0, i * QUAD * n_quads, (i, i), (narrow + i, WIDTH), n_quads
        )
