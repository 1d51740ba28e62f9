"""Stopwatch of a training: the time that its steps take, without interruptions."""

from __future__ import annotations

import statistics
from collections import deque

LONGEST_STEP, TIMES_MEDIAN = 5.0, 20.0
"""Seconds that a step counts at most, or TIMES_MEDIAN times the median of the last steps, if that is more. A
step that takes longer was interrupted: its process was stopped, the machine slept, or a slow disk was written
to in between."""
N_LAST = 15
"""Number of last steps of which the median is taken."""


class Stopwatch:
    """Seconds of training, from the times in seconds at which steps end.

    A first step that compiles code counts as much as the second.

    >>> watch = Stopwatch(seconds=100.0, now=0.0)
    >>> [watch.step_ends(now) for now in (20.0, 20.5, 21.0, 3600.0, 3600.5)]
    [105.0, 101.0, 101.5, 111.5, 112.0]
    >>> watch.at(3600.75)
    112.25
    """

    def __init__(self, seconds: float, now: float) -> None:
        """`seconds`: those before `now`, which is when the first step begins."""
        self._seconds = seconds
        """Those up to the end of the last step."""
        self._end = now
        self._last: deque[float] = deque(maxlen=N_LAST)
        """Seconds that each of the last steps counts."""
        self._first = 0.0
        """Seconds that the first step took, until the second shows how much of it counts."""

    def at(self, now: float) -> float:
        """Return the seconds until `now`, within a step."""
        return self._seconds + self._counted(now)

    def step_ends(self, now: float) -> float:
        """End a step, and return the seconds until `now`."""
        counted = self._counted(now)
        if not self._last:
            self._first = now - self._end
        elif self._first:
            self._seconds += min(self._first, counted) - self._last.pop()
            self._first = 0.0
        self._last.append(counted)
        self._seconds += counted
        self._end = now
        return self._seconds

    def _counted(self, now: float) -> float:
        """Return the seconds that the current step counts if it ends `now`."""
        # The first step says nothing about the others before its own seconds are known.
        typical = statistics.median(self._last) if self._last and not self._first else 0.0
        return min(now - self._end, max(LONGEST_STEP, TIMES_MEDIAN * typical))
