"""numba, where it is installed: the player runs without it, slower."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

try:
    import numba
except ImportError:  # an extra: without it the numpy twin of whatever is compiled runs
    numba = None


def available() -> bool:
    """Whether numba is installed."""
    return numba is not None


def forget_outdated(folder: Path) -> None:
    """Remove compiled code that numba kept in `folder` before any of the sources there was last changed.

    numba looks at the file of a function alone: after an update it would go on with what the function took
    from other files as they were, and compute something else without a word.
    """
    newest = max((path.stat().st_mtime for path in folder.glob("*.py")), default=0.0)
    for kept in folder.glob("__pycache__/*.nbi"):
        with suppress(OSError):  # somebody else removed it, or it is not ours to remove
            if kept.stat().st_mtime <= newest:
                kept.unlink()


def compiled(function: Callable[..., Any], inline: bool = False) -> Callable[..., Any]:
    """A function compiled by numba where that is installed; it runs without the interpreter's lock and may
    not allocate.

    Without counted references: the threads would count the grid's arrays in turns, millions of times a
    picture.
    """
    if numba is None:
        return function
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False, "forceinline": inline}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to keep the compiled code in: compile again in every process
        return numba.njit(**options)(function)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """A part of a compiled function, inlined: a call would pass 60 words."""
    return compiled(function, inline=True)


if numba is not None:
    forget_outdated(Path(__file__).parent)
