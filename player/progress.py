"""A progress bar on stderr, if that is a terminal: frame i of n, ms, time left."""

from __future__ import annotations

import sys
import time


class Bar:
    """Shown as long as its block runs; `advance` once a frame."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._shown = sys.stderr.isatty()
        self._begin = time.perf_counter()
        self._done = 0

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown and self._done:
            sys.stderr.write("\n")

    def advance(self, milliseconds: float) -> None:
        """One more frame is there, which took so long to render."""
        self._done += 1
        if not self._shown:
            return
        left = (time.perf_counter() - self._begin) / self._done * (self._total - self._done)
        filled = "#" * (24 * self._done // self._total)
        sys.stderr.write(
            f"\r[{filled:24}] frame {self._done}/{self._total}  {milliseconds:.0f} ms  "
            f"{duration(left)} left   "
        )
        sys.stderr.flush()


def duration(seconds: float) -> str:
    """Seconds in words that a person reads at a glance.

    >>> duration(7.4), duration(125), duration(7260)
    ('7 s', '2 min 05 s', '2 h 01 min')
    """
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
