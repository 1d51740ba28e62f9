"""Breaks valid inputs, bytes and JSON, with a given random generator."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np

WORDS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**63 - 1, 2**64 - 1)
STRANGE: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 0.5, -0.0, 1e-308, 1e308, 2**31, 2**63, 10**30, -(10**400)),
    *("", "NaN", "../../etc/passwd", "/etc/passwd", "\x00", "a" * 5000, "\ud800", "\u202e", "C:\\x", "~"),
    *([], {}, [[]], {"a": {}}, [1, 2, 3], [[1, 0, 0, 0]] * 4, ["x"] * 16, [1e308] * 16),
)


def broken_bytes(data: bytes, random: np.random.Generator) -> bytes:
    """Return the bytes with one to four changes: bits, words, cuts, repeats, insertions."""
    out = bytearray(data)
    for _ in range(int(random.integers(1, 5))):
        at = int(random.integers(0, len(out) + 1))
        span = int(min(2 ** random.integers(0, 12), len(out)))
        match int(random.integers(0, 7)):
            case 0 if out:
                out[at % len(out)] ^= 1 << int(random.integers(0, 8))
            case 1:
                size = int(random.choice([1, 2, 4, 8]))
                word = WORDS[random.integers(0, len(WORDS))] % 256**size
                out[at : at + size] = word.to_bytes(size, "little")
            case 2:
                del out[at:]
            case 3:
                del out[at : at + span]
            case 4:
                out[at:at] = out[at : at + span]
            case 5:
                out[at:at] = random.bytes(span)
            case 6:
                out[at : at + span] = bytes(min(span, len(out) - at))
    return bytes(out)


def broken_json(data: bytes, random: np.random.Generator) -> bytes:
    """Return JSON with one to three values replaced, removed or repeated, or sometimes broken bytes."""
    if random.random() < 0.25:
        return broken_bytes(data, random)
    document = json.loads(data)
    for _ in range(int(random.integers(1, 4))):
        document = broken_value(document, random)
    if random.random() < 0.02:
        return b"[" * 200_000 + data
    return json.dumps(document).encode("utf-8", "surrogatepass")


def broken_value(value: Any, random: np.random.Generator) -> Any:
    """Return a copy in which some value, at any depth, is replaced, removed or repeated."""
    value = copy.deepcopy(value)
    keys = (
        list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    )
    if not keys or random.random() < 0.15:
        return copy.deepcopy(STRANGE[random.integers(0, len(STRANGE))])
    key = keys[random.integers(0, len(keys))]
    change = random.random()
    if change < 0.1:
        del value[key]
    elif change < 0.2 and isinstance(value, list):
        value[key:key] = [copy.deepcopy(value[key])] * int(random.integers(1, 50))
    elif change < 0.25 and isinstance(value, dict):
        value[str(STRANGE[random.integers(0, len(STRANGE))])] = value[key]
    else:
        value[key] = broken_value(value[key], random)
    return value
