"""Interrupted trainings: what is kept, what is said, and how they go on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from player.errors import OutputError
from vfr_bake.cli import train_main
from vfr_bake.training.checkpoint import checkpoint_path
from vfr_bake.training.model_file import load_model
from vfr_bake.training.trainer import StepReport, Trainer

SMALL = [
    *("--n-levels", "4", "--max-resolution", "32", "--log2-table-size", "12", "--device", "cpu"),
    *("--head-width", "16", "--density-width", "16", "--occupancy-resolution", "16"),
    *("--batch-samples", "1024", "--pilot-steps", "5", "--steps", "12", "--eval-views", "1"),
]  # fmt: skip


def interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def test_an_interrupted_training_goes_on(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C leaves the model and a checkpoint, and --resume goes on and replaces the model."""
    model, report = tmp_path / "model.pt", tmp_path / "train.json"
    words = [str(small_data), str(model), *SMALL, "--json", str(report)]

    def run(trainer: Trainer) -> Iterator[StepReport]:
        for step in whole(trainer):
            yield step
            if trainer.next_step == 7:
                raise KeyboardInterrupt

    whole = Trainer.run
    monkeypatch.setattr(Trainer, "run", run)
    assert train_main(words) == 130
    said = capsys.readouterr()
    assert "interrupted: the same command with --resume goes on" in said.err and "(stopped early)" in said.out
    assert load_model(model).figures["steps"] == json.loads(report.read_text())["steps"] == 7
    assert checkpoint_path(model).exists()
    monkeypatch.setattr(Trainer, "run", whole)
    assert train_main(words) == 1
    assert "model.pt: already exists: add --force" in capsys.readouterr().err
    # The training that has written the checkpoint has held it, so the usual share of memory is no limit.
    monkeypatch.setattr("vfr_bake.training.tensor_files.allowed_bytes", lambda given: int(1e9 * (given or 0)))
    assert train_main([*words, "--resume"]) == 0
    monkeypatch.undo()
    assert "going on after step 7" in capsys.readouterr().err
    assert load_model(model).figures["steps"] == json.loads(report.read_text())["steps"] == 12
    assert not checkpoint_path(model).exists()


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_a_training_without_a_checkpoint_begins_anew(
    force: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main([str(tmp_path / "no data"), str(tmp_path / "model.pt"), "--resume", *force]) == 1
    told = capsys.readouterr().err.splitlines()
    assert "model.pt.checkpoint: no such checkpoint: training begins anew" in told[0]
    assert len(told) == 2 and ": error: " in told[1]


def test_a_model_whose_measurement_is_interrupted_is_complete(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model, report = tmp_path / "model.pt", tmp_path / "train.json"
    words = [str(small_data), str(model), *SMALL, "--checkpoint-minutes", "1e-6", "--json", str(report)]
    for place in ("vfr_bake.commands.train._test_figures", "vfr_bake.training.trainer.Trainer.witness_psnr"):
        monkeypatch.setattr(place, interrupt)
        assert train_main([*words, "--force"]) == 130
        said = capsys.readouterr()
        assert "interrupted: the model is complete, but not measured" in said.err
        assert "model.pt: 12 steps" in said.out and "(stopped early)" not in said.out
        assert load_model(model).figures["steps"] == 12
        assert "test_psnr" not in json.loads(report.read_text())
        assert not checkpoint_path(model).exists()


def test_a_checkpoint_that_cannot_be_written_ends_no_training(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(path: Path, trainer: Trainer) -> None:
        raise OutputError(f"{path}: cannot write: No space left on device")

    monkeypatch.setattr("vfr_bake.training.checkpoint.save_checkpoint", full)
    words = [str(small_data), str(tmp_path / "model.pt"), *SMALL, "--checkpoint-minutes", "1e-6"]
    assert train_main(words) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "No space left" in line]
    assert len(told) == 1 and told[0].endswith("on device: training goes on without it")
    assert load_model(tmp_path / "model.pt").figures["steps"] == 12
