"""Types of the functions that long-running work calls to report its progress."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], object]
"""A function called with (done, of): the steps done and their total."""

Report = Callable[[str, int, int], object]
"""A function called with (stage, done, of): the name of the stage, its steps done and their total."""


def silent(*_: object) -> None:
    """Ignore the call: a Progress or Report for callers that want none."""
