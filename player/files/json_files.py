"""JSON from outside: read with a bound on its size, and what was found there in one short line."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from player.errors import FormatError
from player.files.files import read_bytes

MAX_FILE_BYTES = 64 * 2**20
"""Bytes of a JSON file, at most: enough for sixty thousand cameras of a kilobyte each."""
MOST_VALUES = 8 << 20
"""Values in a JSON file, at most: each takes a hundred bytes of memory or less, and a camera has thirty."""


def read_json(path: str | Path, what: str) -> bytes:
    """The bytes of a JSON file; `what` it should be is for the message.

    Raises FormatError: no such file, not a plain file, over 64 MB.
    """
    return read_bytes(Path(path), what, MAX_FILE_BYTES)


def parse_json(data: bytes, where: str) -> Any:
    """What the bytes say, if it is at most MOST_VALUES values; NaN and Infinity are not JSON.

    Raises FormatError.

    >>> parse_json(b"[1, NaN]", "numbers")
    Traceback (most recent call last):
    player.errors.FormatError: numbers: expected JSON, got NaN, which is not a number of JSON
    """
    n_values = 1 + sum(map(data.count, (b",", b"[", b"{")))
    if n_values > MOST_VALUES:
        raise FormatError(f"{where}: expected at most {MOST_VALUES} values in JSON, got about {n_values}")
    try:
        return json.loads(data.decode("utf-8-sig"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{where}: expected JSON, got {brief(str(error))}") from error


def as_float(value: Any) -> float | None:
    """A finite number as float, None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def brief(value: Any) -> str:
    """What was found, in one short line of plain characters.

    >>> brief("two\\nlines, \\x1e, \\u00fc"), brief([1, None])
    ('two lines, \\\\x1e, \\\\xfc', '[1, None]')
    """
    text = ascii(value if isinstance(value, str) else repr(value))[1:-1]  # nothing breaks the line
    text = text.replace("\\n", " ").replace("\\r", " ")
    return text if len(text) <= 80 else text[:77] + "..."


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name}, which is not a number of JSON")
