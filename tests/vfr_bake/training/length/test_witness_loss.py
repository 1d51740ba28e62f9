"""The loss at the witnesses, compared with sums in float64 that are written out, and with known losses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vfr_bake.data.witnesses import Witnesses
from vfr_bake.training.length.witness_loss import (
    BLOCKS_OF_A_VIEW,
    PATCH_WEIGHT,
    T_FACTORS,
    Loss,
    WitnessLoss,
    _decibels,
)
from vfr_bake.training.scores.metrics import ROUNDING_ERROR

WHITE = np.ones(3, np.float32)


def some_witnesses(counts: list[int], whole: list[int], seed: int = 0) -> Witnesses:
    random = np.random.default_rng(seed)
    pixels = np.concatenate([np.arange(n) for n in counts]).astype(np.int32)
    rgba = random.integers(0, 256, (sum(counts), 4)).astype(np.uint8)
    return Witnesses(np.array(counts, np.int32), pixels, rgba, np.array(whole, np.int32))


def written_out(witnesses: Witnesses, before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Return (loss, standard error) by loops over blocks: views, and the parts of the only view of a kind."""
    blocks: dict[tuple, list[int]] = {}
    views = witnesses.views()
    n_whole = len({view for view in views if view in witnesses.whole})
    n_with_patches = len({*views}) - n_whole
    for i, view in enumerate(views):
        kind = "whole" if view in witnesses.whole else "patches"
        if (n_whole if kind == "whole" else n_with_patches) > 1:
            blocks.setdefault((kind, view), []).append(i)
        else:
            place = i - int(np.flatnonzero(views == view)[0])
            part = place * BLOCKS_OF_A_VIEW // int((views == view).sum())
            blocks.setdefault((kind, part), []).append(i)

    def lost(rows: list[int]) -> float:
        means = (math.fsum(e[i] for i in rows) / len(rows) for e in (before, after))
        first, second = (max(mean, ROUNDING_ERROR) for mean in means)
        return 10 * math.log10(second / first)

    def loss(left_out: tuple | None) -> float:
        of_kind = {}
        for kind in ("patches", "whole"):
            kept = [rows for key, rows in blocks.items() if key[0] == kind and key != left_out]
            if kind == "whole" and n_whole > 1:
                of_kind[kind] = math.fsum(map(lost, kept)) / len(kept)
            elif kept:
                of_kind[kind] = lost([i for rows in kept for i in rows])
        if len(of_kind) == 2:
            return PATCH_WEIGHT * of_kind["patches"] + (1 - PATCH_WEIGHT) * of_kind["whole"]
        return next(iter(of_kind.values()))

    variance = 0.0
    for kind in ("patches", "whole"):
        keys = [key for key in blocks if key[0] == kind]
        if len(keys) > 1:
            without = [loss(key) for key in keys]
            mean = sum(without) / len(without)
            variance += (len(keys) - 1) / len(keys) * sum((each - mean) ** 2 for each in without)
    return loss(None), math.sqrt(variance)


@pytest.mark.parametrize(
    ("counts", "whole"),
    [
        ([7, 5, 40, 6, 0, 9], [2]),
        ([7, 30, 6, 33, 9], [1, 3]),
        ([7, 0, 6, 33, 9], [1, 3]),  # a whole view without witnesses, because it is masked
        ([7, 0, 6, 33, 20], [1, 3, 4]),
        ([7, 0, 6, 0, 9], [1, 3]),
        ([5, 6, 7], []),
        ([4], []),
        ([40, 300], [1]),
        ([0, 3, 0], [1]),
        ([9, 20, 9], [1]),
    ],
)
def test_loss_and_spread_are_those_written_out(counts: list[int], whole: list[int]) -> None:
    witnesses = some_witnesses(counts, whole)
    measured = WitnessLoss(witnesses, WHITE)
    random = np.random.default_rng(1)
    for scale in (1e-9, ROUNDING_ERROR, 0.01, 1.0):
        before, after = random.exponential(scale, (2, sum(counts)))
        loss, spread = written_out(witnesses, before, after)
        found = measured.loss(before, after)
        assert found.db == pytest.approx(loss, abs=1e-9)
        assert found.spread == pytest.approx(spread, abs=1e-9)
        assert found.stated is not None and found.widening >= 0
        assert (found.most, found.least) == pytest.approx((loss + spread, loss - found.stated))
        assert found.worst == pytest.approx(loss + 2 * spread)


def test_errors_are_between_8_bit_pictures_over_the_background() -> None:
    """Errors are between 8-bit pictures, clipped and rounded as in an evaluation, here in integers."""
    witnesses = some_witnesses([50], [])
    background = np.array([0.213, 0.531, 0.917], np.float32)
    rgb = np.random.default_rng(2).uniform(-0.2, 1.2, (50, 3)).astype(np.float32)
    expected = []
    for colour, rgba in zip(rgb.astype(float), witnesses.rgba.astype(float), strict=True):
        alpha = rgba[3] / 255
        shown = [min(max(math.floor(255 * value + 0.5), 0), 255) for value in colour]
        taken = [
            math.floor(255 * (value / 255 * alpha + (1 - alpha) * float(behind)) + 0.5)
            for value, behind in zip(rgba[:3], background, strict=True)
        ]
        expected.append(sum(((a - b) / 255) ** 2 for a, b in zip(shown, taken, strict=True)) / 3)
    errors = WitnessLoss(witnesses, background).errors(rgb)
    np.testing.assert_allclose(errors, expected, atol=1e-12)


def test_no_change_is_no_loss_and_a_better_picture_loses_less_than_nothing() -> None:
    measured = WitnessLoss(some_witnesses([50, 60, 70], []), WHITE)
    errors = np.random.default_rng(3).exponential(0.01, 180)
    assert measured.loss(errors, errors) == (0.0, 0.0, 0.0)
    found = measured.loss(errors, errors / 2)
    assert found.db == pytest.approx(-10 * math.log10(2)) and found.spread == pytest.approx(0, abs=1e-9)
    nothing = np.zeros(180)
    assert measured.loss(nothing, nothing) == (0.0, 0.0, 0.0)
    assert math.isfinite(measured.loss(nothing, errors).db)


def test_errors_below_that_of_rounding_are_no_loss() -> None:
    """A model that is exact at all witnesses, as of a scene of one colour, would lose 80 dB by one level."""
    assert _decibels(np.array([[0.0, 0.0], [0.0, 1e-6]])).tolist() == [0.0, 0.0]
    assert _decibels(np.array([0.0, 1.0])) == pytest.approx(58.92, abs=0.01)


def test_the_spread_is_as_large_as_the_losses_of_other_witnesses_differ() -> None:
    """The spread is that of a thousand draws of witnesses, where errors of a view share a factor."""
    counts, whole = [30] * 40 + [400] * 4, [40, 41, 42, 43]
    measured = WitnessLoss(some_witnesses(counts, whole), WHITE)
    views = np.repeat(np.arange(44), counts)
    random = np.random.default_rng(4)
    losses, spreads = [], []
    for _ in range(1000):
        before = random.exponential(0.01, len(views))
        after = before * random.lognormal(0.1, 0.2, 44)[views]
        found = measured.loss(before, after)
        losses.append(found.db)
        spreads.append(found.spread)
    # A standard deviation of 1000 draws is known to 2 %; a jackknife of four views adds some error.
    assert np.mean(spreads) == pytest.approx(np.std(losses), rel=0.12)


@pytest.mark.parametrize("n_views", [2, 3, 4])
def test_a_loss_lies_within_the_stated_spread_as_often_as_within_a_standard_error(n_views: int) -> None:
    """The losses of the views are normal, so that their mean over its estimated standard error has Student's
    t distribution with one degree of freedom less than there are views."""
    cumulative = {
        2: lambda t: math.atan(t) / math.pi,
        3: lambda t: t / (2 * math.sqrt(2 + t**2)),
        4: lambda t: (t / math.sqrt(3) / (1 + t**2 / 3) + math.atan(t / math.sqrt(3))) / math.pi,
    }
    within = math.erf(1 / math.sqrt(2))
    assert 2 * cumulative[n_views](T_FACTORS[n_views]) == pytest.approx(within, abs=2e-3)
    measured = WitnessLoss(some_witnesses([5] * n_views, list(range(n_views))), WHITE)
    views = np.repeat(np.arange(n_views), 5)
    random = np.random.default_rng(6)
    ones, hits = np.ones(len(views)), []
    for _ in range(2000):
        found = measured.loss(ones, 10 ** (random.normal(0, 0.02, n_views)[views]))
        assert found.stated is not None
        hits.append(abs(found.db) <= found.stated)
    # A share of 2000 draws is known to 0.01.
    assert np.mean(hits) == pytest.approx(within, abs=0.03)


def test_a_single_view_has_a_spread() -> None:
    measured = WitnessLoss(some_witnesses([48], []), WHITE)
    before, after = np.random.default_rng(5).exponential(0.01, (2, 48))
    found = measured.loss(before, after)
    assert found.most > found.db + 0.1


def test_a_loss_in_words() -> None:
    assert str(Loss(0.1234, 0.02)) == "0.12 dB (give or take 0.02)"
    assert str(Loss(0.1234, 0.02, 0.01)) == "0.12 dB (give or take 0.03)"
    assert Loss(0.1234, 0.02, 0.01).most == 0.1234 + 0.02, "choices do not depend on what is stated"
    assert str(Loss(0.1234, None)) == "an expected 0.12 dB" and Loss(0.5, None).most == 0.5
