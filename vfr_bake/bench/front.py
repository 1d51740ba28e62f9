"""The Pareto front: the settings that no other setting of the front beats in quality, time and size at once.

Quality is in dB, time in ms per frame, size in MB. Times are known only to within their uncertainty, and
noise must not exclude a setting. So A beats B if A is at least as good, at least as small and not slower
beyond the uncertainty of both, and if it is better, smaller or faster (beyond the uncertainty) in something.

If A beats B and B beats C, C may still be faster than A beyond the uncertainty. B is then no reason to leave
out C. So settings join the front from the best quality down, and only those of the front exclude others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

MAX_LOSS_DB, MAX_MS, MAX_MB = 0.1, 100.0, 20.0
"""Limits on the loss in dB, on the milliseconds of a frame and on the megabytes. For each of them
a setting is recommended."""


@dataclass(frozen=True)
class Point:
    """Quality, time and size of one setting."""

    name: str
    psnr: float
    """PSNR against the photographs, dB."""
    ms: float
    uncertainty: float
    """Half width of the interval around `ms` that noise alone explains, milliseconds."""
    megabytes: float


def beats(a: Point, b: Point) -> bool:
    """Return whether `a` leaves no reason to choose `b`.

    >>> slow, fast = Point("slow", 30.0, 90.0, 2.0, 8.0), Point("fast", 30.0, 50.0, 2.0, 8.0)
    >>> beats(fast, slow), beats(slow, fast), beats(slow, slow)
    (True, False, False)
    """
    noise = a.uncertainty + b.uncertainty
    no_worse = a.psnr >= b.psnr and a.megabytes <= b.megabytes and a.ms <= b.ms + noise
    return no_worse and (a.psnr > b.psnr or a.megabytes < b.megabytes or a.ms < b.ms - noise)


def pareto_front(points: Sequence[Point]) -> list[bool]:
    """Return for each of the points whether it is on the front.

    >>> pareto_front([Point("a", 34.0, 100, 15, 5), Point("b", 33.9, 85, 15, 5), Point("c", 33.8, 60, 15, 5)])
    [True, False, True]
    """
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (-p.psnr, p.megabytes, p.ms)):  # none beats one before it
        if not any(beats(other, point) for other in front):
            front.append(point)
    return [point in front for point in points]


def recommend(points: Sequence[Point], reference: float, against: str) -> tuple[str, list[Point]]:
    """Return one sentence that recommends settings for at most MAX_LOSS_DB, MAX_MS and MAX_MB, and the
    settings that it names, each once.

    `points` are those of assets, `reference` is the PSNR that losses are counted from,
    and `against` is its name.

    >>> some = [Point("k 5", 30.0, 90.0, 1.0, 24.0), Point("k 2", 29.0, 50.0, 1.0, 18.0)]
    >>> sentence, named = recommend(some, 30.05, "the model")
    >>> sentence
    'For at most 0.1 dB below the model play k 5 (0.05 dB, 90 ms, 24 MB); for at most 100 ms a frame play \
k 5 (0.05 dB, 90 ms, 24 MB); for at most 20 MB play k 2 (1.05 dB, 50 ms, 18 MB).'
    >>> [point.name for point in named]
    ['k 5', 'k 2']
    """
    named: list[Point] = []

    def told(point: Point) -> str:
        return f"{reference - point.psnr:.2f} dB, {point.ms:.0f} ms, {point.megabytes:.0f} MB"

    def best_for(wanted: str, limit: float, cost: Callable[[Point], float], fast: bool = False) -> str:
        """Return the words that recommend a setting whose cost is at most `limit`: the fastest one if `fast`,
        else the one of the best quality."""
        fitting = [point for point in points if cost(point) <= limit]
        if not fitting:
            chosen, verb = min(points, key=cost), "there is none, nearest is"
        else:
            chosen = min(fitting, key=lambda p: (p.ms, -p.psnr) if fast else (-p.psnr, p.ms))
            verb = "play"
        if chosen not in named:
            named.append(chosen)
        return f"for {wanted} {verb} {chosen.name} ({told(chosen)})"

    below = f"at most {MAX_LOSS_DB:g} dB below {against}"
    parts = (
        best_for(below, MAX_LOSS_DB, lambda point: reference - point.psnr, fast=True),
        best_for(f"at most {MAX_MS:g} ms a frame", MAX_MS, lambda point: point.ms),
        best_for(f"at most {MAX_MB:g} MB", MAX_MB, lambda point: point.megabytes),
    )
    sentence = "; ".join(parts)
    return f"{sentence[0].upper()}{sentence[1:]}.", named
