"""When a training ends, and the expectation that is printed when it starts."""

from __future__ import annotations

import itertools
import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vfr_bake.config import Effort, TrainConfig
from vfr_bake.data.demo import demo_scene, demo_views
from vfr_bake.data.witnesses import choose_witnesses
from vfr_bake.training.length.duration import FIRST_LOOK, GROWTH, Duration
from vfr_bake.training.length.expectation import LATER_STEP, expectation, grown, typical_step
from vfr_bake.training.length.witness_loss import WitnessLoss
from vfr_bake.training.trainer import Trainer

CHOSEN = choose_witnesses(demo_views(32, 24, 1)[0])
WITNESSES, N = WitnessLoss(CHOSEN, np.ones(3)), len(CHOSEN.pixels)


def looks(
    duration: Duration, gain_of_a_doubling: float, n: int, noise: float = 0.0, first: float = FIRST_LOOK
) -> list[float]:
    """Let the error fall by so many dB with each doubling of the time; return the times [s] of `n` looks, the
    first of which is due after `first` seconds."""
    random = np.random.default_rng(0)
    times, now = [], 0.0

    def measure() -> tuple[WitnessLoss, np.ndarray]:
        times.append(now)
        errors = np.full(N, 1e-2 * 10 ** (-gain_of_a_doubling * math.log2(now) / 10))
        return WITNESSES, errors * np.exp(noise * random.normal(size=N))

    for number in range(n):
        now = first * GROWTH**number * (1 + 1e-9 * number)  # not too early, even after rounding
        duration.look(1, now - 1e-3, measure)  # too early for a look
        duration.look(1, now, measure)
    return times


@pytest.mark.parametrize(
    ("gain", "ends"), [(0.0, True), (0.1, True), (-0.5, True), (0.2, False), (3.0, False)]
)
def test_a_flat_error_ends_it_and_a_falling_one_does_not(gain: float, ends: bool) -> None:
    duration = Duration(10**6, 60.0)
    times = looks(duration, gain, 4)
    assert np.allclose(np.diff(np.log2(times)), 0.5)
    assert duration.ended_early == ends
    # The second half takes as long as the first did.
    assert math.isclose(duration.progress(1, times[-1]), 0.5 if ends else times[-1] / 3600)


def test_one_flat_look_is_chance_and_so_is_an_error_that_varies_as_much() -> None:
    duration = Duration(10**6, 60.0)
    looks(duration, 0.0, 3)
    assert not duration.ended_early
    noisy = Duration(10**6, 60.0)
    looks(noisy, 0.1, 6, noise=1.0)
    assert not noisy.ended_early


def test_nobody_looks_in_the_second_half() -> None:
    duration = Duration(10**6, 4.0)
    assert looks(duration, 0.0, 2) and not duration.ended_early
    assert len(looks(Duration(10**6, 2.0), 0.0, 5, first=60.1)) == 0


@pytest.mark.parametrize("minutes", [0.5, 2.0, 10.0])
def test_a_short_training_ends_early_too(minutes: float) -> None:
    """As `--effort draft` does, which takes 2 minutes."""
    first = 6 * minutes
    flat, falling = Duration(10**6, minutes), Duration(10**6, minutes)
    times = looks(flat, 0.0, 4, first=first)
    assert len(times) == 4 and times[0] == first
    assert flat.ended_early and math.isclose(flat.progress(1, times[-1]), 0.5)
    looks(falling, 3.0, 4, first=first)
    assert not falling.ended_early


def test_what_was_seen_is_kept_and_the_length_may_change() -> None:
    one, other = Duration(10**6, 60.0), Duration(10**6, 60.0)
    looks(one, 0.0, 3)
    other.restore(one.state())
    for duration in (one, other):
        duration.look(1, 1.01 * FIRST_LOOK * GROWTH**3, lambda: (WITNESSES, np.full(N, 1e-2)))
    assert one.ended_early and other.ended_early
    assert one.progress(1, 100.0) == other.progress(1, 100.0)
    longer = Duration(10**6, 1.0)
    longer.restore(one.state())
    assert longer.progress(1, 60.0) == 1.0


def test_a_training_whose_error_is_flat_stops_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training whose error is flat ends early. Its clock moves on by a second at each look, and the field's
    learning rates are too small to learn anything."""
    clock = itertools.count()
    monkeypatch.setattr("vfr_bake.training.trainer.time", SimpleNamespace(monotonic=lambda: next(clock)))
    monkeypatch.setattr("vfr_bake.training.length.duration.FIRST_LOOK", 6.0)
    scene = demo_scene(size=32, n_train=20, n_test=1)
    settings: dict[str, Any] = {
        "minutes": 20.0, "grid_rate": 1e-9, "network_rate": 1e-9, "batch_samples": 1024, "device": "cpu"
    }  # fmt: skip
    trainer = Trainer(scene, TrainConfig(pilot_steps=3, **settings))
    reports = list(trainer.run())
    assert trainer.duration.ended_early
    assert reports[-1].progress < 1 and reports[-1].seconds < 100
    asked = Trainer(scene, TrainConfig(steps=60, pilot_steps=3, **settings))
    assert len(list(asked.run())) == 60 and not asked.duration.ended_early
    # While the pilot network learns, the head's error is flat, but says nothing.
    pilot = Trainer(scene, TrainConfig(pilot_steps=1000, **settings))
    assert len(list(itertools.islice(pilot.run(), 60))) == 60 and not pilot.duration.ended_early


def test_the_expectation_counts_the_steps_that_come_first() -> None:
    assert "about 1,000 steps in 0.42 minutes" in expectation(18.0, 400, 10.0, 0.025, 1000, 10.0, False)
    assert "about 400 steps" in expectation(18.0, 400, 10.0, 0.025, 400, 10.0, False)
    assert "18 to 18 dB" in expectation(18.0, 400, 10.0, 0.025, 10, 10.0, False)


@pytest.mark.parametrize(
    ("psnr", "seconds", "seconds_a_step", "n_steps", "minutes", "unbounded", "reached"),
    [
        (20.8, 25.0, 0.021, 24_809, 9.25, False, 34.38),  # lego_400
        (22.4, 35.0, 0.025, 4_087, 2.25, False, 34.91),  # the built-in scene
        (22.0, 30.0, 0.031, 14_621, 12.0, True, 32.27),  # fox at half size
        (28.3, 30.0, 0.031, 17_021, 12.0, True, 34.55),  # can, its own cameras
    ],
)
def test_what_is_expected_is_what_was_reached(
    psnr: float,
    seconds: float,
    seconds_a_step: float,
    n_steps: int,
    minutes: float,
    unbounded: bool,
    reached: float,
) -> None:
    """Steps and PSNR are about those expected. The measured ones, with PSNR on test views, are of two
    trainings of objects on two cores with AVX2 and of two trainings of captures with AVX-512."""
    said = expectation(psnr, 400, seconds, seconds_a_step, 1_000_000, minutes, unbounded)
    found = re.search(r"about ([\d,]+) steps .* (\d+) to (\d+) dB", said)
    assert found
    steps, low, high = (int(number.replace(",", "")) for number in found.groups())
    assert n_steps / 1.35 < steps < 1.35 * n_steps
    assert low - 0.5 <= reached <= high + 0.5, "both are rounded"


@pytest.mark.parametrize("unbounded", [False, True])
def test_a_training_that_goes_on_is_expected_to_end_as_it_was_before(unbounded: bool) -> None:
    """The steps of a later run are longer by the growth of the batches, and shorter by what surfaces save."""

    def steps(step: int, seconds: float, seconds_a_step: float) -> int:
        said = expectation(None, step, seconds, seconds_a_step, 1_000_000, 12.0, unbounded)
        found = re.search(r"about ([\d,]+) steps in 12 minutes at most$", said)
        assert found
        return int(found[1].replace(",", ""))

    first = 0.02 / LATER_STEP[unbounded]
    whole = steps(200, 30.0, first)
    assert whole == pytest.approx(steps(400, 34.0, first), rel=0.1)
    for step in (5000, 9000):
        size = grown(step + 1, unbounded) - grown(step, unbounded)
        seconds = 30.0 + 0.02 * (grown(step, unbounded) - 200)
        assert steps(step, seconds, 0.02 * size) == pytest.approx(whole, rel=0.1)


@pytest.mark.parametrize(("minutes", "said"), [(0.5, "0.5"), (2.25, "2.2"), (120.0, "120"), (1e4, "10,000")])
def test_minutes_are_said_in_two_digits_or_whole(minutes: float, said: str) -> None:
    text = expectation(18.0, 400, 10.0, 0.025, 10**9, minutes, False)
    assert f" steps in {said} minutes at most" in text


def test_the_expectation_leaves_out_the_time_that_compiling_took() -> None:
    assert "about 1,000 steps in 2 minutes" in expectation(18.0, 400, 90.0, 0.05, 1_000_000, 2.0, False)


def test_a_clock_that_moves_on_rarely_still_tells_a_time() -> None:
    ticks = [16e-3 * (step // 4) for step in range(101)]
    assert typical_step(ticks) == pytest.approx(4e-3)
    assert "ms a step" in expectation(18.0, 400, 10.0, typical_step([10.0] * 101), 1000, 10.0, False)


def test_efforts_are_minutes_at_most() -> None:
    wanted: dict[Effort, tuple[int, int]] = {"draft": (2, 2), "good": (10, 12), "best": (60, 60)}
    for effort, minutes in wanted.items():
        config = TrainConfig(effort=effort)
        assert tuple(config.minutes_for("cpu", kind) for kind in (False, True)) == minutes
        assert TrainConfig(effort=effort, minutes=7.0).minutes_for("cpu", False) == 7
        assert config.minutes_for("cuda", False) == (2 if effort == "draft" else math.inf)
