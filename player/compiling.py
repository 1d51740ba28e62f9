"""Compilation by numba where it is installed; without it the player runs more slowly."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

try:
    import numba
except ImportError:  # numba is an extra: without it, the numpy twins of compiled code run
    numba = None
else:
    from player.kept_code import is_kept, keep, place

SOURCES = Path(__file__).parent
"""The folder of the sources of all compiled code of the player: everything in it and below counts."""


def available() -> bool:
    """Return whether numba is installed."""
    return numba is not None


def first_use() -> bool:
    """Return whether numba is installed, but no compiled march is kept yet: the first picture then waits for
    compilation."""
    return numba is not None and not is_kept("_march_rays", SOURCES)


def not_kept() -> str | None:
    """Explain in a line why compiled code is not kept; None if it is."""
    if numba is None or (refused := place(SOURCES).refused) is None:
        return None
    return (
        f"{refused}: expected a folder that nobody else may write to: "
        "compiled code is not kept there, and is compiled again every time"
    )


def compiled(function: Callable[..., Any], inline: bool = False) -> Callable[..., Any]:
    """Compile a function by numba, if numba is installed. The function releases the interpreter's lock and
    may not allocate.

    References are not counted: the threads would take turns to count those to the grid's arrays, millions of
    times per picture.
    """
    if numba is None:
        return function
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False, "forceinline": inline}
    return keep(numba.njit(**options)(function), SOURCES)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a part of another compiled function, to be inlined: a call would pass 60 words."""
    return compiled(function, inline=True)
