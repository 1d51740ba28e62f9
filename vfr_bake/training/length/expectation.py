"""Prediction of the steps that a training will take, and of the PSNR that it is likely to reach, from its
first steps.

Each doubling of the number of steps gains less than the one before: the total gain grows with the square root
of the number of doublings. The PSNR after EXPECTED_AT steps is extrapolated by this rule. The factor of the
root differs from scene to scene, so the result is a range.
"""

from __future__ import annotations

import math
import statistics
from bisect import bisect_left
from itertools import pairwise

from vfr_bake.training.guides import FOG_STEPS, GROWTH

TIMED = 100
"""Number of last steps from which the speed is measured. A step of the pilot network takes about as long as
one of the head."""
SAID_AT = 200
"""Number of steps of a run after which the length of the training is predicted. A training that is resumed is
a new run, maybe on another machine."""
EXPECTED_AT = 400
"""Step after which the result is predicted, too; not earlier, because the first 300 steps teach the pilot
network, and not the head."""
DB_OF_DOUBLINGS = {False: (5.0, 7.0), True: (1.5, 4.5)}
"""Least and largest gain in dB for one doubling, which is multiplied by the root of their number, by whether
the scene is unbounded. From 400 steps to the end of 2 to 12 minutes it was 5.6 with lego, 6.7 to 7.0 with the
built-in scene, 4.1 with fox and 1.5 with can (docs/notes/2026-11-28-rays-and-steps.md)."""
LATER_STEP = {False: 1.0, True: 0.45}
"""Mean time of the later steps, in units of that of a step at EXPECTED_AT, by whether the scene is unbounded:
rays through contracted space have fewer and fewer samples as surfaces form. It holds for the first FOG_STEPS
steps, in which each ray has its full number of samples."""
LARGER_BATCH = {False: 0.6, True: 1.0}
"""Additional time of a batch of twice the first size, in steps of the first size, by whether the scene is
unbounded. It is below 1 for objects: the more samples, the more of them share rows of the table."""


def typical_step(ends: list[float]) -> float:
    """Return the seconds that a step takes, from the times in seconds at which at least two steps ended. It
    is the median, because compiling code in one of the first steps takes as long as hundreds of steps; or the
    mean, if the clock's resolution is too low for a median. It is never 0.

    >>> round(typical_step([10.0, 10.01, 14.0, 14.01, 14.02]), 6)
    0.01
    >>> typical_step([0.0, 0.0, 0.0, 0.0156, 0.0156])
    0.0039
    """
    median = statistics.median(after - before for before, after in pairwise(ends))
    return median or max((ends[-1] - ends[0]) / (len(ends) - 1), 1e-9)


def grown(n: int, unbounded: bool) -> float:
    """Return the time of `n` steps on a CPU, in units of a step with the first batch size: as batches grow,
    steps take longer and longer.

    >>> grown(1000, True), grown(4000, True), grown(10_000, True)
    (1000.0, 5000.0, 25000.0)
    """
    after, most = GROWTH[unbounded]
    proportional = min(n, most * after)
    added = max(0.0, proportional - after) ** 2 / (2 * after) + (most - 1) * (n - proportional)
    return n + LARGER_BATCH[unbounded] * added


def steps_of(time: float, unbounded: bool) -> int:
    """Return the number of steps that take the given `time`: the inverse of `grown`.

    >>> [steps_of(grown(n, True), True) for n in (1000, 5000, 20_000)]
    [1000, 5000, 20000]
    """
    return bisect_left(range(math.ceil(time)), time, key=lambda n: grown(n, unbounded))


def expectation(
    psnr: float | None,
    step: int,
    seconds: float,
    seconds_a_step: float,
    n_steps: int,
    minutes: float,
    unbounded: bool,
    on_cpu: bool = True,
) -> str:
    """Say what to expect of a training that ends after `n_steps` or `minutes`. Its first `step` steps took
    `seconds` in all, some of them to compile code, and the last of these steps `seconds_a_step` each. `psnr`:
    that after EXPECTED_AT steps in dB, None if it is not known.

    >>> expectation(18.0, 400, 30.0, 0.025, 1_000_000, 10.0, False)
    '25 ms a step: about 18,000 steps in 10 minutes at most, which give scenes like this 30 to 34 dB'
    >>> expectation(None, 200, 40.0, 0.025, 20_000, math.inf, False, on_cpu=False)
    '25 ms a step: about 20,000 steps in 8.9 minutes at most'
    """
    if on_cpu and step < FOG_STEPS:
        seconds_a_step *= LATER_STEP[unbounded]
    left = (60 * minutes - seconds) / seconds_a_step
    if on_cpu:
        done = grown(step, unbounded)
        size = grown(step + 1, unbounded) - done
        possible = min(n_steps, max(step, steps_of(done + left * size, unbounded)))
        later = (grown(possible, unbounded) - done) / size
    else:  # batches do not grow
        possible = int(min(n_steps, step + max(left, 0.0)))
        later = possible - step
    rounded = round(possible, 1 - len(str(possible)) + 1)
    taken = min(minutes, (seconds + max(later, 0.0) * seconds_a_step) / 60)
    minutes_said = f"{taken:.2g}" if taken < 10 else f"{taken:,.0f}"
    said = f"{1000 * seconds_a_step:.0f} ms a step: about {rounded:,} steps in {minutes_said} minutes at most"
    if psnr is None:
        return said
    doublings = max(0.0, math.log2(possible / EXPECTED_AT))
    low, high = (round(psnr + gain * math.sqrt(doublings)) for gain in DB_OF_DOUBLINGS[unbounded])
    return f"{said}, which give scenes like this {low} to {high} dB"
