"""Progress of the commands on stderr: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

SECONDS_BETWEEN_LINES = 30.0
"""Where stderr is no terminal, progress is a line this often instead of a bar."""


class Bar:
    """A tqdm bar on stderr where that is a terminal, else a line now and then."""

    def __init__(self, title: str, shown: bool = True) -> None:
        self._title = title
        self._shown = shown
        self._bar: Any = None
        self._last_line = time.monotonic()
        self._begin = self._last_line

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def count(self, done: int, of: int) -> None:
        self._show(done / of if of else 1.0, f"{done}/{of}")

    def share(self, share: float, text: str) -> None:
        self._show(share, text)

    def _show(self, share: float, text: str) -> None:
        if not self._shown:
            return
        if not sys.stderr.isatty():
            if time.monotonic() - self._last_line > SECONDS_BETWEEN_LINES:
                self._last_line = time.monotonic()
                left = (self._last_line - self._begin) * (1 - share) / max(share, 1e-9)
                print(f"{self._title}: {share:.0%}, {left:.0f} s left, {text}", file=sys.stderr, flush=True)
            return
        if self._bar is None:
            from tqdm import tqdm

            # Its own lock is shared with other processes, and to make one starts a process where
            # multiprocessing does not fork: needless, and that one looks for modules in the current folder.
            tqdm.set_lock(threading.RLock())
            layout = "{desc} {percentage:3.0f}% |{bar}| {elapsed} < {remaining}  {postfix}"
            self._bar = tqdm(total=1.0, desc=self._title, bar_format=layout, file=sys.stderr)
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(share - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class Bars:
    """One bar after the other, by what is being done."""

    def __init__(self) -> None:
        self._bars: dict[str, Bar] = {}

    def __enter__(self) -> Bars:
        return self

    def __exit__(self, *_: object) -> None:
        for bar in self._bars.values():
            bar.close()

    def count(self, what: str, done: int, of: int) -> None:
        bar = self._bars.setdefault(what, Bar(what))
        bar.count(done, of)
        if done >= of:
            bar.close()
