"""How many threads work is shared out to."""

from __future__ import annotations

import os

from player.errors import ConfigError

MOST_THREADS = 16
"""Threads a core, at most: more finish nothing sooner, and each has scratch arrays of its own."""


def default_threads() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def bounded_threads(n_threads: int) -> int:
    """So many, but at most MOST_THREADS a core; raises ConfigError for none."""
    if n_threads < 1:
        raise ConfigError(f"threads: expected at least 1, got {n_threads}")
    return min(n_threads, MOST_THREADS * default_threads())
