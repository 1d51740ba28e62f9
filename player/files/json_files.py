"""Read JSON files from outside with bounds on their size, and quote what was found in one short line."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from player.errors import FormatError
from player.files.files import read_bytes

MAX_FILE_BYTES = 64 * 2**20
"""The most bytes of a JSON file: enough for sixty thousand cameras of a kilobyte each."""
MOST_VALUES = 8 << 20
"""The most values in a JSON file: each takes a hundred bytes of memory or less, and a camera has thirty."""


def read_json(path: str | Path, what: str) -> bytes:
    """Return the bytes of a JSON file; `what` says in error messages what it is expected to be.

    Raises FormatError: no such file, not a regular file, over 64 MiB.
    """
    return read_bytes(Path(path), what, MAX_FILE_BYTES)


def parse_json(data: bytes, where: str) -> Any:
    """Parse bytes as JSON.

    Raises FormatError: not JSON (NaN and Infinity are not), or more than about MOST_VALUES values.

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
    """Return a finite number as float, and None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def brief(value: Any) -> str:
    """Return a value that was found as one short line of ASCII characters, for messages.

    >>> brief("two\\nlines, \\x1e, \\u00fc"), brief([1, None])
    ('two lines, \\\\x1e, \\\\xfc', '[1, None]')
    """
    text = ascii(value if isinstance(value, str) else repr(value))[1:-1]  # nothing breaks the line
    text = text.replace("\\n", " ").replace("\\r", " ")
    return text if len(text) <= 80 else text[:77] + "..."


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name}, which is not a number of JSON")
