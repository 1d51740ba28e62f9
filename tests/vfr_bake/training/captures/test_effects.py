"""Training on pictures with changing exposure or something that moves, and on pictures without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.vfr_bake.training.captures.altered import changed_exposure, scene_of, settings, trained
from vfr_bake.data.demo import demo_views
from vfr_bake.evaluation import render_views
from vfr_bake.training.captures import effects, exposure
from vfr_bake.training.checkpoint import load_checkpoint, save_checkpoint
from vfr_bake.training.model_file import load_model, save_model, trained_model
from vfr_bake.training.processes import Processes
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


def seen_of(cells: torch.Tensor) -> effects.Seen:
    """Return what a step sees that draws a pixel of each cell, if those of `cells` contradict the others."""
    pictures, rows, columns = torch.meshgrid(*(torch.arange(n) for n in cells.shape), indexing="ij")
    n, side = cells.numel(), cells.shape[1]
    places = (torch.stack([columns, rows], dim=-1).view(n, 2) + 0.5) / side
    errors = (0.01 + 0.4 * cells.view(n, 1)).expand(n, 3)
    some, all_of = torch.full((n, 3), 0.5), torch.ones(n)
    return effects.Seen(pictures.reshape(n), places, some, all_of, some, all_of > 0, errors)


def test_what_moves_is_left_out_unless_that_is_most_of_the_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effects, "CHECKS", (16, 32))
    found = effects.CaptureEffects(8, Processes(0, 1), torch.device("cpu"))
    scattered, person, most = torch.zeros(3, 8, 16, 16, dtype=torch.bool)
    scattered[:, ::2, ::3] = scattered[:, 1::4, 1::3] = True  # a quarter of the cells
    person[:, 4:12, 4:8] = True
    most[:, :12] = True

    def observe(cells: torch.Tensor) -> None:
        for _ in range(16):
            found.observe(seen_of(cells), cells.numel())

    observe(scattered)
    assert 0.25 < (found.moving_share or 0) < 0.3 and not found.moving_on and found.share_left_out == 0
    found = effects.CaptureEffects(8, Processes(0, 1), torch.device("cpu"))
    observe(person)
    assert found.moving_on and found.share_left_out == 60 / 256
    for _ in range(8):
        observe(most)
    assert not found.moving_on and found.share_left_out == 0
    some = seen_of(most)
    assert found.learned(some.pictures, some.places) is None


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
