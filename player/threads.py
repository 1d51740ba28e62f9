"""The number of threads that share the work."""

from __future__ import annotations

import operator
import os

from player.errors import ConfigError
from player.files.json_files import brief

MOST_THREADS = 16
"""Most threads per core: more finish nothing sooner, and each has scratch arrays of its own."""


def default_threads() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def bounded_threads(n_threads: int) -> int:
    """Return `n_threads`, but at most MOST_THREADS per core; raises ConfigError unless it is a whole number
    from 1 on."""
    try:
        n_threads = operator.index(n_threads)
    except TypeError:
        raise ConfigError(f"threads: expected a whole number, got {brief(n_threads)}") from None
    if n_threads < 1:
        raise ConfigError(f"threads: expected at least 1, got {n_threads}")
    return min(n_threads, MOST_THREADS * default_threads())
