"""PSNR and warnings about views between the pictures, from witnesses of both kinds."""

from __future__ import annotations

import numpy as np
import pytest

from vfr_bake.config import TrainConfig
from vfr_bake.data.demo import demo_scene
from vfr_bake.training.length.witness_errors import WitnessErrors
from vfr_bake.training.scores.between import MOST_APART, WitnessPsnr, witness_psnr
from vfr_bake.training.trainer import Trainer


def test_whole_pictures_are_told_apart_from_pixels_of_learned_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(demo_scene(size=32, n_train=20, n_test=1), TrainConfig(device="cpu", steps=1))
    probes: list[WitnessErrors] = []

    def errors(self: WitnessErrors, *_: object) -> np.ndarray:
        probes.append(self)
        return np.where(self.loss.is_whole, 0.01, 0.001)

    monkeypatch.setattr(WitnessErrors, "errors", errors)
    found = trainer.witness_psnr()
    assert found is not None and found.patches is not None
    assert (round(found.patches, 6), found.whole) == (30.0, 20.0) and 20 < found.every < 30
    counts = trainer.witnesses.counts
    assert probes[0].loss.is_whole.mean() == pytest.approx(counts[10] / counts.sum(), abs=0.01)
    assert len(found.lines()) == 2 and found.lines()[1].startswith("warning: views between")


def test_pictures_without_any_error_have_a_finite_psnr() -> None:
    """The PSNR of exact pictures, such as those of one colour, is finite: JSON needs a number."""
    found = witness_psnr(np.zeros(4), np.array([False, True, True, False]))
    assert found == pytest.approx((58.92, 58.92, 58.92), abs=0.01)


def test_patches_that_show_background_alone_say_nothing_of_fog() -> None:
    found = witness_psnr(np.array([0.0, 0.001]), np.array([False, True]))
    assert found.patches is not None and found.whole is not None
    assert found.patches > found.whole + MOST_APART and found.lines() == []


def test_there_is_no_warning_without_a_difference_or_without_whole_pictures() -> None:
    assert len(WitnessPsnr(30.0, 32.0, 32.0 - MOST_APART + 0.01).lines()) == 1
    assert WitnessPsnr(30.0, 30.0, None).lines() == []


def test_what_effects_take_out_of_the_pictures_is_not_called_fog() -> None:
    trainer = Trainer(demo_scene(size=32, n_train=20, n_test=1), TrainConfig(device="cpu", steps=1))
    trainer.effects.exposure_on = True
    assert trainer.witness_psnr() is None


def test_a_scene_too_small_for_witnesses_has_none() -> None:
    trainer = Trainer(demo_scene(size=6, n_train=4, n_test=1), TrainConfig(device="cpu", steps=1))
    assert trainer.witness_psnr() is None
