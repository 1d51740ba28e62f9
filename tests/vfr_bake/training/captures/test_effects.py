"""Training on pictures with changing exposure or something that moves, and on pictures without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.vfr_bake.training.captures.altered import changed_exposure, scene_of, settings, trained
from vfr_bake.data.demo import demo_views
from vfr_bake.training.captures import effects, exposure
from vfr_bake.training.checkpoint import load_checkpoint, save_checkpoint
from vfr_bake.training.model_file import load_model, save_model, trained_model
from vfr_bake.training.scores.evaluation import render_views
from vfr_bake.training.trainer import Trainer


def test_unchanged_pictures_are_learned_from_as_they_are() -> None:
    scene = scene_of()
    trainer = trained(scene)
    assert not trainer.effects.exposure_on and not trainer.effects.moving_on
    assert trainer.effects.exposure_gain is not None and trainer.effects.exposure_gain < 0.1
    model = trained_model(trainer, scene, {})
    assert model.exposure is None and model.neutral_witnesses() is model.witnesses
    assert all(view.first_column == 0 for view in render_views(model, scene.test))
    said = " ".join(trainer.effects.described())
    assert "the same in all pictures" in said and "none found" in said


def test_changing_exposure_is_found_learned_and_kept(tmp_path: Path) -> None:
    scene = scene_of(exposure=0.15, seed=1)
    trainer = trained(scene)
    assert trainer.effects.exposure_on and "changes from picture to picture" in trainer.effects.described()[0]
    # The gains that were put in are found, up to a factor that all pictures share.
    learned = trainer.witnesses.learned()
    gains = changed_exposure(demo_views(8, 40, 1)[0], 1, 0.15)[1][learned]
    found = trainer.effects.correction.gains.numpy()
    assert np.corrcoef(found[:, 1], gains[:, 1])[0, 1] > 0.7, "0.82 to 0.86 with three seeds"
    np.testing.assert_allclose(found.mean(axis=0), 1, rtol=1e-9)

    model = trained_model(trainer, scene, {})
    save_model(tmp_path / "m.pt", model)
    again = load_model(tmp_path / "m.pt")
    assert model.exposure is not None and again.exposure is not None
    assert np.array_equal(again.exposure.gains, model.exposure.gains)
    assert (
        again.exposure.gains.shape == (40, 3) and (again.exposure.gains[trainer.witnesses.whole] != 1).all()
    )
    assert all(view.first_column == 32 for view in render_views(model, scene.test))

    save_checkpoint(tmp_path / "c", trainer)
    resumed = Trainer(scene, settings())
    load_checkpoint(tmp_path / "c", resumed)
    assert torch.equal(resumed.effects.correction.gains, trainer.effects.correction.gains)
    assert resumed.effects.figures() == trainer.effects.figures()


def test_a_step_that_is_not_finite_leaves_them_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effects, "STEPS_PER_UPDATE", 1)
    scene = scene_of(size=32)
    trainer = Trainer(scene, settings(steps=12, pilot_steps=0))
    for report in trainer.run():
        if report.step == 4:
            before = trainer.effects.state()
            kept = {name: before[name].clone() for name in ("halves", "cells", "gains")}
            with torch.no_grad():
                trainer._field.head.out.bias.fill_(float("nan"))
        if report.step > 4:
            assert report.loss != report.loss
    assert trainer.n_bad_steps == 7
    state = trainer.effects.state()
    assert all(torch.equal(state[name], tensor) for name, tensor in kept.items())
    assert exposure.gain_on_other_half(trainer.effects._halves.view(-1, 2, 3, 6)) < 1
