"""Frame times, measured in rounds that ask every process in turn, so that a busy minute of the
machine affects all of them.

A round visits each asset and size once, in random order. A visit renders one view with every k and quality
of the asset, also in random order, after one frame that is not counted. Times are those of whole frames.

March and lookups are one loop and cannot be timed apart. For one view, only the lookups differ with k. So a
slope b is fitted to the march's time against the number of lookups, over the exact frames of each visit, and
the median of all visits is taken. Then `lookups = b x fetches`, and the march is the rest. Medians are used
so that a single pause has no effect.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from player.march.interpolation import Quality

Size = tuple[int, int]
"""Width and height of a frame in pixels."""


class Dials(NamedTuple):
    """Settings of the player with which a frame is rendered."""

    n_fetches: int
    """k, feature lookups per ray; 0 for one at every sample."""
    quality: Quality = "exact"

    def request(self) -> dict[str, Any]:
        """Return the settings as a request to a process has them."""
        return {"samples": self.n_fetches, "quality": self.quality}


Ask = Callable[..., dict[str, Any]]
FEWEST_ROUNDS = 2
"""Rounds that are made however long they take: with fewer there is no spread."""
SEED = 0
"""Seed of the random orders within the rounds."""


@dataclass(frozen=True)
class Times:
    """Milliseconds of a setting's frames of one size."""

    median: float
    p95: float
    quartiles: tuple[float, float]
    uncertainty: float
    """Half width of the interval within which two medians do not differ: 1.57 interquartile ranges over
    the root of the number of frames (the notches of McGill, Tukey and Larsen, 1978). The times are
    first divided by the mean of all settings in the same round, which removes the effect of the view
    and of the machine's state."""
    frames: int
    march: float
    """Median time of the march in a frame, without the lookups."""
    lookups: float | None
    """Median time of the lookups in a frame. None if only one k was played, so that march and lookups cannot
    be told apart; `march` then holds both."""
    head: float
    rest: float


def measure_times(
    players: Sequence[Ask],
    n_views: int,
    sizes: Sequence[Size],
    dials: Sequence[Sequence[Dials]],
    n_rounds: int,
    until: float,
    progress: Callable[[int, int], object],
) -> dict[tuple[int, Dials, Size], Times]:
    """Return the times of every (player, dials, size); each of `players` is a function that asks
    one process for a frame, and has its own `dials`.

    There are `n_rounds` rounds, or fewer if not all are expected to end before `until`, a time of the clock
    `time.monotonic()`; but at least FEWEST_ROUNDS.
    """
    random = np.random.default_rng(SEED)
    visits: dict[tuple[int, Size], list[dict[Dials, dict[str, Any]]]] = {}
    places = [(player, size) for player in range(len(players)) for size in sizes]
    begin, turn, done = time.monotonic(), 0, 0
    while turn < n_rounds:
        for index in random.permutation(len(places)):
            player, size = places[index]
            ask, own = players[player], dials[player]
            request = {"view": turn % n_views, "size": size, "rgb": None}
            ask(**request, **own[0].request())
            order = random.permutation(len(own))
            answers = {own[i]: ask(**request, **own[i].request()) for i in order}
            visits.setdefault((player, size), []).append(answers)
            done += 1
            progress(done, n_rounds * len(places))
        turn += 1
        # Not 0: the resolution of some clocks is only 16 ms.
        a_round = max(time.monotonic() - begin, 1e-9) / turn
        n_rounds = int(min(n_rounds, max((until - begin) / a_round, FEWEST_ROUNDS)))
    times = {}
    for (player, size), rounds in visits.items():
        slope = lookup_slope(rounds)
        shared = [_mean_ms([visits[other, size][number] for other in range(len(players))])
                  for number in range(turn)]  # fmt: skip
        for some in dials[player]:
            times[player, some, size] = frame_times([answers[some] for answers in rounds], slope, shared)
    return times


def _mean_ms(visits: Sequence[dict[Dials, dict[str, Any]]]) -> float:
    return float(np.mean([answer["ms"] for answers in visits for answer in answers.values()]))


def notch(ms: np.ndarray, shared: Sequence[float]) -> float:
    """Return the uncertainty of the median of `ms` [n], one frame per round, where `shared` [n] is the mean
    time of all settings in each round.

    >>> notch(np.array([10.0, 40.0, 20.0]), [1.0, 4.0, 2.0])  # slow rounds, but always ten times the mean
    0.0
    """
    low, high = np.percentile(ms / np.asarray(shared), [25, 75])
    return float(1.57 * (high - low) * np.mean(shared) / len(ms) ** 0.5)


def lookup_slope(rounds: Sequence[dict[Dials, dict[str, Any]]]) -> float | None:
    """Return the milliseconds per feature lookup of exact frames; None if their number
    of lookups never differs.

    >>> few, many = {"fetches": 10, "march_ms": 7.0}, {"fetches": 20, "march_ms": 9.0}
    >>> lookup_slope([{Dials(1): few, Dials(2): many}])
    0.2
    """
    slopes = []
    for answers in rounds:
        exact = [answer for dials, answer in answers.items() if dials.quality == "exact"]
        fetches = np.array([answer["fetches"] for answer in exact], np.float64)
        march = np.array([answer["march_ms"] for answer in exact], np.float64)
        if not len(exact):
            continue
        fetches -= fetches.mean()
        if fetches.any():
            slopes.append(float(fetches @ march / (fetches @ fetches)))
    return max(float(np.median(slopes)), 0.0) if slopes else None


def frame_times(answers: Sequence[dict[str, Any]], slope: float | None, shared: Sequence[float]) -> Times:
    """Return the times of frames from a process's answers to each; `slope` is the milliseconds per feature
    lookup, and `shared` is what `notch` divides by."""
    ms, march, head, fetches = (
        np.array([answer[key] for answer in answers], np.float64)
        for key in ("ms", "march_ms", "head_ms", "fetches")
    )
    lookups = None if slope is None else min(slope * float(np.median(fetches)), float(np.median(march)))
    low, high = np.percentile(ms, [25, 75])
    return Times(
        median=float(np.median(ms)),
        p95=float(np.percentile(ms, 95)),
        quartiles=(float(low), float(high)),
        uncertainty=notch(ms, shared),
        frames=len(ms),
        march=float(np.median(march)) - (lookups or 0.0),
        lookups=lookups,
        head=float(np.median(head)),
        rest=float(np.median(ms - march - head)),
    )
