"""numba, where it is installed: the player runs without it, slower."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

try:
    import numba
    from numba.core import config
except ImportError:  # an extra: without it the numpy twin of whatever is compiled runs
    numba = None


def available() -> bool:
    """Whether numba is installed."""
    return numba is not None


def first_use() -> bool:
    """Whether numba is there and has kept no march yet: the first picture waits until it is compiled."""
    if numba is None or os.environ.get("NUMBA_CACHE_DIR"):
        return False
    return not any((Path(__file__).parent / "__pycache__").glob("*march_compiled*.nbi"))


def forget_outdated(folder: Path, *others: Path) -> None:
    """Remove compiled code that numba kept in `folder` if any of the sources there, or in `others` that they
    take functions from, is not what it was then.

    numba looks at the file of a function alone: after an update it would go on with what the function took
    from other files as they were, and compute something else without a word. Times are compared for
    equality: a clock that was wrong does no harm.
    """
    paths = [path for place in (folder, *others) for path in sorted(place.glob("*.py"))]
    files = [(path.name, path.stat()) for path in paths]
    sources = "\n".join(f"{name} {stat.st_size} {stat.st_mtime_ns}" for name, stat in files)
    note = folder / "__pycache__" / "compiled_from.txt"
    with suppress(OSError):  # nothing kept yet; or somebody else removed it, or it is not ours to remove
        if note.is_file() and note.read_text() == sources:
            return
        for kept in folder.glob("__pycache__/*.nbi"):
            kept.unlink(missing_ok=True)
        note.parent.mkdir(exist_ok=True)
        note.write_text(sources)


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
    # numba reads settings from a file in the current folder. One of them is the folder of compiled code,
    # which is unpickled: whoever writes that file runs code. Without a name there is no such file.
    config._config_fname = ""  # pyright: ignore[reportAttributeAccessIssue]
    config.reload_config()
    forget_outdated(Path(__file__).parent)
