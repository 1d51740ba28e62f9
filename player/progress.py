"""Progress of work: the functions that long-running work calls, and a bar on stderr if that is a terminal, or
else a line now and then."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable

Progress = Callable[[int, int], object]
"""A function called with (done, of): the steps done and their total."""

Report = Callable[[str, int, int], object]
"""A function called with (stage, done, of): the name of the stage, its steps done and their total."""

SECONDS_BETWEEN_LINES = 30.0
"""Seconds between two lines of progress, which are written instead of a bar where stderr is no terminal."""
SECONDS_BETWEEN_BARS = 0.1
"""Least time in seconds until a bar is drawn again, except for the last time."""
CELLS = 24
"""Length of a bar in characters."""


def silent(*_: object) -> None:
    """Ignore the call: a Progress or Report for callers that want none."""


class Bar:
    """The progress of one piece of work. A context manager; without `with`, `close` ends the bar.

    >>> with Bar("reading pictures") as bar:
    ...     bar.count(1, 2)
    """

    def __init__(self, title: str = "", shown: bool = True, lines: bool = True) -> None:
        """`shown`: whether to write anything; `lines`: whether to write lines where there is no terminal."""
        self._title = title
        self._on_terminal = sys.stderr.isatty()
        self._shown = shown and (self._on_terminal or lines)
        self._begin, self._before = time.monotonic(), 0.0
        self._written = -SECONDS_BETWEEN_BARS if self._on_terminal else self._begin
        self._length = 0

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def began(self, share: float) -> None:
        """Say that a share 0..1 of the work is done by now, but that its time says nothing about the rest: an
        earlier run did it, or code was compiled meanwhile."""
        self._begin, self._before = time.monotonic(), share

    def count(self, done: int, of: int) -> None:
        """Report that `done` of `of` things are done."""
        self.share(done / of if of else 1.0, f"{done}/{of}")

    def share(self, share: float, text: str) -> None:
        """Report that a share 0..1 of the work is done; `text` is written beside it."""
        if not self._shown:
            return
        now = time.monotonic()
        elapsed, done = now - self._begin, share - self._before
        left = duration(elapsed * (1 - share) / done) if done > 0 else "?"
        if not self._on_terminal:
            if now - self._written > SECONDS_BETWEEN_LINES:
                self._written = now
                self._write(f"{self._title}: {share:.0%}, {left} left, {text}\n")
        elif share >= 1 or now - self._written >= SECONDS_BETWEEN_BARS:
            self._written = now
            filled = "#" * int(CELLS * share)
            line = f"{self._title} {share:4.0%} |{filled:{CELLS}}| {duration(elapsed)} < {left}  {text}"
            line = line.removeprefix(" ")[: shutil.get_terminal_size().columns - 1]
            self._write("\r" + line.ljust(self._length))  # overwrite the rest of a longer line with spaces
            self._length = len(line)

    def close(self) -> None:
        """End the line of the bar."""
        if self._length:
            self._write("\n")
            self._length = 0

    def _write(self, text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()


class Bars:
    """Bars for several kinds of work, one after the other. A context manager."""

    def __init__(self) -> None:
        self._bars: dict[str, Bar] = {}

    def __enter__(self) -> Bars:
        return self

    def __exit__(self, *_: object) -> None:
        for bar in self._bars.values():
            bar.close()

    def count(self, what: str, done: int, of: int) -> None:
        """Report that `done` of `of` things of the work called `what` are done."""
        if what not in self._bars:
            self._bars[what] = Bar(what)
        self._bars[what].count(done, of)
        if done >= of:
            self._bars[what].close()


def duration(seconds: float) -> str:
    """Format seconds for people to read at a glance.

    >>> duration(7.4), duration(125), duration(7260)
    ('7 s', '2 min 05 s', '2 h 01 min')
    """
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
