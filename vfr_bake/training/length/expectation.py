"""What a training is likely to reach, told from its first steps.

What a training gains with each doubling of its steps gets less: it grows with the root of the number of
doublings, so that what a look after EXPECTED_AT steps finds can be carried forward. How fast it grows differs
from scene to scene: the result is a range.
"""

from __future__ import annotations

import math
import statistics
from bisect import bisect_left
from itertools import pairwise

from vfr_bake.training.guides import GROWTH

TIMED_FROM, EXPECTED_AT = 300, 400
"""The speed is that of the steps between these two: before them the pilot network learns."""
DB_OF_DOUBLINGS = {False: (5.0, 7.0), True: (1.5, 4.5)}
"""Gain in dB at the least and at the most, times the root of the number of doublings, by whether the scene is
unbounded. From 400 steps to the end of 2 to 12 minutes it was 5.6 with lego, 6.7 to 7.0 with the built-in
scene, 4.1 with fox and 1.5 with can (docs/notes/2026-11-28-rays-and-steps.md)."""
LATER_STEP = {False: 1.0, True: 0.45}
"""How long steps take on the whole, in steps of that look: rays through contracted space have ever fewer
samples as surfaces form."""
LARGER_BATCH = {False: 0.6, True: 1.0}
"""What a batch of twice the size takes more, in steps of the first size: samples of an object share ever more
rows of the table."""


def typical_step(ends: list[float]) -> float:
    """Seconds that a step takes, by the seconds at which steps ended, two of them at least: the median,
    because whatever is compiled in the first of them takes as long as hundreds.

    >>> round(typical_step([10.0, 10.01, 14.0, 14.01, 14.02]), 6)
    0.01
    """
    return statistics.median(after - before for before, after in pairwise(ends))


def grown(n: int, unbounded: bool) -> float:
    """Time of `n` steps on a CPU, in steps of its first batches: those of batches that grow take ever longer.

    >>> grown(1000, True), grown(4000, True), grown(10_000, True)
    (1000.0, 5000.0, 25000.0)
    """
    after, most = GROWTH[unbounded]
    proportional = min(n, most * after)
    added = max(0.0, proportional - after) ** 2 / (2 * after) + (most - 1) * (n - proportional)
    return n + LARGER_BATCH[unbounded] * added


def steps_of(time: float, unbounded: bool) -> int:
    """The number of steps that take so much `time`: the inverse of `grown`.

    >>> [steps_of(grown(n, True), True) for n in (1000, 5000, 20_000)]
    [1000, 5000, 20000]
    """
    return bisect_left(range(math.ceil(time)), time, key=lambda n: grown(n, unbounded))


def expectation(
    psnr: float, seconds: float, seconds_a_step: float, n_steps: int, minutes: float, unbounded: bool
) -> str:
    """What to expect of a training that has `psnr` dB after EXPECTED_AT steps, which took `seconds`, most of
    them to compile code, and ends after `n_steps` or `minutes`.

    >>> expectation(18.0, 30.0, 0.025, 1_000_000, 10.0, False)
    '25 ms a step: about 18,000 steps in 10 minutes at most, which give scenes like this 30 to 34 dB'
    """
    seconds_a_step *= LATER_STEP[unbounded]
    later = (60 * minutes - seconds) / seconds_a_step
    possible = min(n_steps, EXPECTED_AT + steps_of(later, unbounded))
    doublings = max(0.0, math.log2(possible / EXPECTED_AT))
    low, high = (round(psnr + gain * math.sqrt(doublings)) for gain in DB_OF_DOUBLINGS[unbounded])
    rounded = round(possible, 1 - len(str(possible)) + 1)
    later = grown(max(possible - EXPECTED_AT, 0), unbounded)
    taken = min(minutes, (seconds + later * seconds_a_step) / 60)
    return (
        f"{1000 * seconds_a_step:.0f} ms a step: about {rounded:,} steps in {taken:.2g} minutes at most, "
        f"which give scenes like this {low} to {high} dB"
    )
