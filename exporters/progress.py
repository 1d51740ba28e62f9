"""How long work says how far it is: the functions that are called meanwhile."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], object]
"""Called with (done, of)."""

Report = Callable[[str, int, int], object]
"""Called with (stage, done, of)."""


def silent(*_: object) -> None:
    """Progress, or a report, that nobody wants to hear of."""
