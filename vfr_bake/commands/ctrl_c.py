"""Ctrl-C as a request, for work whose steps should not be left half done."""

from __future__ import annotations

import signal
import threading
from types import FrameType


class CtrlC:
    """While this context lasts and `waits` is set, the first Ctrl-C sets `pressed` and nothing else. Any
    other raises KeyboardInterrupt, as usual. Nothing is changed where Ctrl-C is ignored, or in other threads
    than the main one, which alone gets it."""

    def __init__(self) -> None:
        self.pressed = False
        self.waits = False

    def __enter__(self) -> CtrlC:
        is_main = threading.current_thread() is threading.main_thread()
        self._before = signal.getsignal(signal.SIGINT) if is_main else None
        if callable(self._before):
            signal.signal(signal.SIGINT, self._press)
        return self

    def __exit__(self, *_: object) -> None:
        if callable(self._before):
            signal.signal(signal.SIGINT, self._before)

    def _press(self, number: int, frame: FrameType | None) -> None:
        if self.pressed or not self.waits:
            raise KeyboardInterrupt
        self.pressed = True
