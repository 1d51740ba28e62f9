"""Choice of the size of the next picture: small while the camera moves, so that motion is smooth; full once
the camera stands still.

While the camera moves, the size is found by feedback: from the time that the last picture took and the time
that it may take follows how many pixels the next one gets. Nothing is assumed about machine, asset or view.
"""

from __future__ import annotations

import math

FRAME_SECONDS = 1 / 15
"""Seconds that a picture may take while the camera moves."""

SHARE = 0.8
"""Share of FRAME_SECONDS that rendering may take; the rest is for encoding and sending."""

STILL_SECONDS = 0.15
"""Seconds without a move after which the camera counts as standing still."""

SHARP_SECONDS = 0.5
"""Seconds that rendering the first picture after a move may take, so that it is on the screen within a
second."""

LEAST = 64 * 48
"""Pixels of the smallest picture: nothing can be recognised in a smaller one."""

MOST = 1920 * 1080
"""Pixels of the largest picture while moving, however fast they come."""


class Pace:
    """Controller of the sizes of pictures for one window.

    >>> pace = Pace()
    >>> pace.measured(10_000, 0.04)  # a quarter less than it may take
    >>> pace.moving(400, 300)
    (133, 100)
    """

    def __init__(self) -> None:
        self._pixels = 20_000.0

    def measured(self, pixels: int, seconds: float) -> None:
        """Learn from the time that a picture of so many pixels took while the camera moved."""
        wanted = pixels * SHARE * FRAME_SECONDS / max(seconds, 1e-4)
        # The number at most doubles or halves at a time: one hiccup of the machine does not blur the next ten
        # pictures.
        self._pixels = min(max(min(wanted, 2 * self._pixels), self._pixels / 2, LEAST), MOST)

    def moving(self, width: int, height: int) -> tuple[int, int]:
        """Return the size of the next picture while the camera moves, for a window of `width` x `height`."""
        return fitted(width, height, self._pixels)

    def sharp(self, width: int, height: int) -> tuple[int, int]:
        """Return the size of the first picture after the camera has come to a stand."""
        return fitted(width, height, self._pixels * SHARP_SECONDS / (SHARE * FRAME_SECONDS))


def fitted(width: int, height: int, pixels: float) -> tuple[int, int]:
    """Return a window's size, scaled down in proportion to about `pixels` pixels if it has more.

    >>> fitted(800, 600, 120_000), fitted(800, 600, 1e9)
    ((400, 300), (800, 600))
    """
    scale = min(1.0, math.sqrt(pixels / (width * height)))
    return max(1, round(width * scale)), max(1, round(height * scale))
