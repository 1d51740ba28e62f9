"""Tests of the limit on what a bake may lose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from player.errors import TrainingError
from player.progress import silent
from tests.vfr_bake.baking.conftest import SMALL
from vfr_bake.baking.bake import _Bake, bake
from vfr_bake.baking.limits import LossMissedError
from vfr_bake.baking.refinement import Stored
from vfr_bake.baking.report import BakeResult
from vfr_bake.config import BakeConfig
from vfr_bake.presets import PRESETS, Preset
from vfr_bake.training.length.witness_loss import Loss
from vfr_bake.training.model_file import Model


def test_a_loss_that_is_not_measured_misses_nothing(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model without witnesses is baked within any limit of the loss, and the bake says that the loss could
    not be measured. No loss that is only expected is warned of."""
    monkeypatch.setitem(PRESETS, "balanced", replace(PRESETS["balanced"], target_loss_db=1e-6))
    old = replace(model, witnesses=None, training_pixels=None)
    result = bake(old, tmp_path / "a", BakeConfig(preset="balanced", **SMALL), silent)
    assert result.loss.db > 1e-6 and result.loss.spread is None and result.missed == []
    result = bake(old, tmp_path / "b", BakeConfig(max_loss_db=1e-6, **SMALL), silent)
    (missed,) = result.missed
    assert missed.startswith("loss: expected at most 1e-06 dB, which could not be measured")


def test_detail_takes_no_more_than_half_of_the_loss_that_is_left(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Refinement has lost 0.3 dB, and the preset gives up 0.06 dB of detail if that is not limited."""
    work = _Bake(model, BakeConfig(preset="balanced", **SMALL), silent)
    layout, _ = work._cells()
    stored = work._store(layout, 20_000)
    allowed: list[float] = []

    def detail(held_out: Any, head: Any, n_fetches: int, most_db: float, progress: Any) -> None:
        allowed.append(most_db)
        raise TrainingError("as far as this")

    def refined(tuning: Any, stored: Stored, *_: Any) -> Stored:
        tuning.kept = SimpleNamespace(loss=Loss(0.3, 0.0))
        return stored

    monkeypatch.setattr(work, "_cells", lambda: (layout, 20_000))
    monkeypatch.setattr(work, "_store", lambda *_: stored)
    monkeypatch.setattr("vfr_bake.baking.bake.Tuning.run", refined)
    monkeypatch.setattr("vfr_bake.baking.bake.Detail", detail)
    for limit in (None, 9.0, 0.34, 0.2):
        work.config = replace(work.config, max_loss_db=limit)
        with pytest.raises(TrainingError, match="as far as this"):
            work.run(tmp_path / "asset", False)
    assert allowed == pytest.approx([0.06, 0.06, 0.02, 0.0])
    work.config = replace(work.config, preset=None)  # 0.2 dB is less than balanced has lost
    with pytest.raises(LossMissedError, match=r"lose 0\.30 dB \(give or take 0\.00\), more than 0\.2 dB"):
        work.run(tmp_path / "asset", False)


@pytest.mark.parametrize("preset", [None, "balanced"])
def test_a_bake_begins_again_with_fidelity_where_balanced_loses_too_much(
    preset: Preset | None, model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a preset, a limit that balanced misses takes fidelity; the time of both bakes counts."""
    tried: list[str] = []

    def run(work: _Bake, folder: Path, force: bool) -> BakeResult:
        tried.append(work.choice.preset)
        work.seconds["refinement"] = 30.0
        if work.choice.preset == "balanced":
            raise LossMissedError("it loses 0.3 dB")
        return BakeResult(0, 0, 30.0, Loss(0.1, 0.0), {"left_out": work.left_out}, [])

    monkeypatch.setattr(_Bake, "run", run)
    config = BakeConfig(preset=preset, max_loss_db=0.2, **SMALL)
    if preset is not None:
        with pytest.raises(LossMissedError):
            bake(model, tmp_path / "asset", config, silent)
        return
    result = bake(model, tmp_path / "asset", config, silent)
    assert tried == ["balanced", "fidelity"]
    assert (
        result.figures["left_out"]["preset"] == "balanced: it loses more than 0.2 dB" and result.seconds > 60
    )
