"""Trainings: what is said before they begin, what is kept if they are interrupted, and how they go on."""

from __future__ import annotations

import json
import pkgutil
import re
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

from player.errors import DataError, OutputError
from tests.vfr_bake.data.check.test_check import walk
from tests.vfr_bake.data.files.test_video import write_video
from vfr_bake.cli import train_main
from vfr_bake.data.files.estimate_record import EstimateRecord
from vfr_bake.data.files.masks import stray_masks
from vfr_bake.data.poses import PoseReport
from vfr_bake.training.checkpoint import checkpoint_path
from vfr_bake.training.model_file import load_model
from vfr_bake.training.trainer import Trainer

SMALL = [
    *("--n-levels", "4", "--max-resolution", "32", "--log2-table-size", "12", "--device", "cpu"),
    *("--head-width", "16", "--density-width", "16", "--occupancy-resolution", "16"),
    *("--batch-samples", "1024", "--pilot-steps", "5", "--steps", "12", "--eval-views", "1"),
]  # fmt: skip


def interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["MODEL", "--html", "page.html"], "--html: does nothing without --check"),
        (["MODEL", "--check", "--steps", "5"], "--steps: does nothing with --check"),
        *(
            (["--check", "--max-side", "240", *words], f"{words[0]}: does nothing with --check")
            for words in (
                ["--resume"],
                ["--preview"],
                ["--no-cache"],
                ["--steps", "5"],
                ["--head-width", "16"],
                ["--scale", "a", "b", "1"],
            )
        ),
    ],
)
def test_options_that_do_nothing_are_refused(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(tmp_path / "model.pt") if word == "MODEL" else word for word in options]
    assert train_main([str(tmp_path), *words]) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert message in told and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--preview"], "model.preview.png: already exists: add --force"),
        (["--device", "cuda"], "device: expected a GPU"),
    ],
)
def test_what_is_sure_to_end_a_training_is_told_before_any_work(
    options: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The data, which are not there, would be missed next."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    (tmp_path / "model.preview.png").write_bytes(b"")
    assert train_main([str(tmp_path / "no data"), str(tmp_path / "model.pt"), *options]) == 1
    (told,) = capsys.readouterr().err.splitlines()
    assert message in told


@pytest.mark.parametrize("suffix", ["zip", "avi"])
def test_a_zip_and_a_video_are_looked_at_before_their_cameras_are_estimated(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if suffix == "zip":
        data = shutil.make_archive(str(tmp_path / "photos"), "zip", walk(tmp_path / "walk", 6))
    else:
        data = str(write_video(tmp_path / "walk.avi", [8.0 * number for number in range(12)]))

    def estimate(*_: Any) -> PoseReport:
        raise DataError("found none")

    monkeypatch.setattr("vfr_bake.data.poses.estimate_cameras", estimate)
    assert train_main([data, str(tmp_path / "model.pt"), *SMALL]) == 1
    told = capsys.readouterr().err.splitlines()
    assert "pictures of" in told[0] and "hang together" in told[1] and told[-1].endswith("found none")


def test_the_page_of_a_check_has_the_whole_name_of_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = walk(tmp_path / "2024.05.garden", 2)
    shutil.make_archive("2024.06.garden", "zip", folder)
    for name in ("2024.05.garden/", "2024.06.garden.zip"):
        assert train_main([name, "--check"]) == 0
    pages = sorted(path.name for path in tmp_path.glob("*.html"))
    assert pages == ["2024.05.garden_check.html", "2024.06.garden_check.html"]


def test_masks_of_no_picture_are_told_of_once(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a first run both the estimation of the cameras and the reading of the pictures find them."""
    photos = shutil.copytree(small_data, tmp_path / "photos")
    (photos / "masks").mkdir()
    (photos / "masks" / "stray.png").write_bytes(b"")
    (photos / "transforms_test.json").unlink()
    cameras = (photos / "transforms_train.json").rename(tmp_path / "transforms_train.json")

    def estimate(folder: Path, progress: Any, say: Any) -> PoseReport:
        say(stray_masks(folder, []))
        cameras.rename(photos / cameras.name)
        return PoseReport(folder, 12, 12, 0.5, 3.0, EstimateRecord(True))

    monkeypatch.setattr("vfr_bake.data.poses.estimate_cameras", estimate)
    monkeypatch.setattr("vfr_bake.commands.train._warn_of_folds", interrupt)
    assert train_main([str(photos), str(tmp_path / "model.pt"), *SMALL]) == 130
    assert capsys.readouterr().err.count("1 of 1 masks belong to no picture (stray.png)") == 1


def press_in_step(step: int, times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Press Ctrl-C in the middle of a step: after its gradients, before its tables are stepped."""
    whole = Trainer._backward

    def backward(trainer: Trainer, *arguments: Any) -> bool:
        finite = whole(trainer, *arguments)
        for _ in range(times if trainer.next_step == step else 0):
            signal.raise_signal(signal.SIGINT)
        return finite

    monkeypatch.setattr(Trainer, "_backward", backward)


def test_an_interrupted_training_goes_on(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C in the middle of a step leaves the model and a checkpoint as they are after that step, and
    --resume goes on and replaces the model by the one that a training without an interruption gives."""
    model, report = tmp_path / "model.pt", tmp_path / "train.json"
    words = [str(small_data), str(model), *SMALL, "--json", str(report)]

    alone = tmp_path / "alone.pt"
    assert train_main([str(small_data), str(alone), *SMALL]) == 0
    capsys.readouterr()
    press_in_step(6, 1, monkeypatch)
    assert train_main(words) == 130
    said = capsys.readouterr()
    assert "interrupted: the same command with --resume goes on" in said.err and "(stopped early)" in said.out
    assert load_model(model).figures["steps"] == json.loads(report.read_text())["steps"] == 7
    assert checkpoint_path(model).exists() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.undo()
    assert train_main(words) == 1
    assert "model.pt: already exists: add --force" in capsys.readouterr().err
    # The training that has written the checkpoint has held it, so the usual share of memory is no limit.
    monkeypatch.setattr("vfr_bake.training.tensor_files.allowed_bytes", lambda given: int(1e9 * (given or 0)))
    assert train_main([*words, "--resume"]) == 0
    monkeypatch.undo()
    assert "going on after step 7" in capsys.readouterr().err
    assert load_model(model).figures["steps"] == json.loads(report.read_text())["steps"] == 12
    assert not checkpoint_path(model).exists()
    fields = [load_model(path).field.state_dict() for path in (alone, model)]
    assert all(torch.equal(tensor, fields[1][name]) for name, tensor in fields[0].items())


@pytest.fixture
def told_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a training say what to expect after 4 steps, and what it is likely to reach after 8."""
    monkeypatch.setattr("vfr_bake.training.length.expectation.SAID_AT", 4)
    monkeypatch.setattr("vfr_bake.training.length.expectation.EXPECTED_AT", 8)


def expected(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Return what has been said of the length, without the speed."""
    return re.findall(r"ms a step: (about .*)", capsys.readouterr().err)


@pytest.mark.usefixtures("told_soon")
def test_a_training_says_what_to_expect_at_its_start_and_when_it_goes_on(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(small_data), str(tmp_path / "model.pt"), *SMALL]
    press_in_step(8, 1, monkeypatch)
    assert train_main(words) == 130
    length, result = expected(capsys)
    assert re.fullmatch(r"about 12 steps in \S+ minutes at most", length)
    assert re.fullmatch(r"about 12 steps in \S+ minutes at most, which give .* to \d+ dB", result)
    monkeypatch.setattr("vfr_bake.training.length.expectation.SAID_AT", 2)
    assert train_main([*words, "--resume"]) == 0
    (length,) = expected(capsys)
    assert re.fullmatch(r"about 12 steps in \S+ minutes at most", length)


@pytest.mark.usefixtures("told_soon")
def test_a_training_whose_error_is_not_known_says_how_long_it_takes(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As while exposure or moving things are corrected."""
    monkeypatch.setattr(Trainer, "witness_psnr", lambda trainer: None)
    assert train_main([str(small_data), str(tmp_path / "model.pt"), *SMALL]) == 0
    (length,) = expected(capsys)
    assert re.fullmatch(r"about 12 steps in \S+ minutes at most", length)


@pytest.mark.parametrize(("step", "says"), [(2, True), (6, False)])
def test_a_training_that_ends_before_the_head_has_learned_says_so(
    step: int,
    says: bool,
    small_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    press_in_step(step, 1, monkeypatch)
    assert train_main([str(small_data), str(tmp_path / "model.pt"), *SMALL]) == 130
    assert ("the model shows random colours: train longer" in capsys.readouterr().err) == says


@pytest.mark.parametrize(("step", "times"), [(0, 1), (6, 2)])
def test_ctrl_c_in_the_first_step_or_twice_ends_at_once(
    step: int,
    times: int,
    small_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Nothing is written of a step that is half done."""
    press_in_step(step, times, monkeypatch)
    assert train_main([str(small_data), str(tmp_path / "model.pt"), *SMALL]) == 130
    assert capsys.readouterr().err.endswith("vfr-train: interrupted\n")
    assert not (tmp_path / "model.pt").exists() and not checkpoint_path(tmp_path / "model.pt").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_while_the_checkpoint_is_written(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The model, which is written first, is reported nevertheless."""
    press_in_step(6, 1, monkeypatch)
    monkeypatch.setattr("vfr_bake.training.checkpoint.save_checkpoint", interrupt)
    assert train_main([str(small_data), str(tmp_path / "model.pt"), *SMALL]) == 130
    said = capsys.readouterr()
    assert "interrupted twice: " in said.err and "model.pt: 7 steps" in said.out
    assert load_model(tmp_path / "model.pt").figures["steps"] == 7


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


@pytest.mark.parametrize(
    "place", ["preview.Preview.write", "model_file.trained_model", "model_file.save_model"]
)
def test_ctrl_c_after_the_last_step_waits_for_the_model(
    place: str,
    small_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    model = tmp_path / "model.pt"
    whole = pkgutil.resolve_name(f"vfr_bake.training.{place}")

    def pressed(*arguments: Any, **named: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return whole(*arguments, **named)

    monkeypatch.setattr(f"vfr_bake.training.{place}", pressed)
    assert train_main([str(small_data), str(model), *SMALL, "--preview"]) == 130
    assert "interrupted: the model is complete, but not measured" in capsys.readouterr().err
    assert load_model(model).figures["steps"] == 12 and not checkpoint_path(model).exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


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
