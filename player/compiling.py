"""numba, where it is installed: the player runs without it, slower."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

try:
    import numba
except ImportError:  # an extra: without it the numpy twin of whatever is compiled runs
    numba = None
else:
    from player.kept_code import is_kept, keep, place

SOURCES = Path(__file__).parent
"""The sources of all compiled code of the player: whatever lies in this folder and below."""


def available() -> bool:
    """Whether numba is installed."""
    return numba is not None


def first_use() -> bool:
    """Whether numba is there and has kept no march yet: the first picture waits until it is compiled."""
    return numba is not None and not is_kept("_march_rays", SOURCES)


def not_kept() -> str | None:
    """Why compiled code is not kept, in a line for people; None where it is."""
    if numba is None or (refused := place(SOURCES).refused) is None:
        return None
    return (
        f"{refused}: expected a folder that nobody else may write to: "
        "compiled code is not kept there, and is compiled again every time"
    )


def compiled(function: Callable[..., Any], inline: bool = False) -> Callable[..., Any]:
    """A function compiled by numba where that is installed; it runs without the interpreter's lock and may
    not allocate.

    Without counted references: the threads would count the grid's arrays in turns, millions of times a
    picture.
    """
    if numba is None:
        return function
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False, "forceinline": inline}
    return keep(numba.njit(**options)(function), SOURCES)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """A part of a compiled function, inlined: a call would pass 60 words."""
    return compiled(function, inline=True)
