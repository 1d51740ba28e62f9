"""The commands of training and baking: contract, exit codes, one-line errors, and no half-written files."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from player.asset.asset import Asset
from player.errors import DataError
from vfr_bake.cli import bake_main, eval_main, train_main
from vfr_bake.commands.train import EVAL_VIEWS, _as_folder, _find_cameras, _test_figures
from vfr_bake.config import EFFORT_MINUTES, TrainConfig
from vfr_bake.data import load_scene
from vfr_bake.data.files.estimate_record import EstimateRecord
from vfr_bake.data.poses import PoseReport
from vfr_bake.data.scene import PosedImages
from vfr_bake.evaluation import RenderedView
from vfr_bake.rendering.render import render_image
from vfr_bake.training.checkpoint import checkpoint_path, save_checkpoint
from vfr_bake.training.model_file import Model, load_model, save_model
from vfr_bake.training.scores.metrics import over_background, psnr, to_8_bit
from vfr_bake.training.trainer import Trainer

SMALL = [
    *("--n-levels", "6", "--max-resolution", "48", "--log2-table-size", "13"),
    *("--head-width", "24", "--density-width", "16", "--occupancy-resolution", "32"),
    *("--batch-samples", "4096", "--pilot-steps", "20"),
]  # fmt: skip


@pytest.fixture(scope="module")
def model(small_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.pt"
    assert train_main([str(small_data), str(path), "--steps", "150", *SMALL]) == 0
    return path


def one_error(capsys: pytest.CaptureFixture[str], *parts: str) -> None:
    lines = [line for line in capsys.readouterr().err.splitlines() if ": error: " in line]
    assert len(lines) == 1, lines
    for part in parts:
        assert part in lines[0]


def test_train_reports_what_it_measured(
    small_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = str(tmp_path / "model.pt")
    assert train_main([str(small_data), model, "--steps", "25", "--json", "-", *SMALL]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["steps"] == 25 and figures["test_views"] == 2 and figures["skipped_steps"] == 0
    assert eval_main([model, str(small_data), "--json", "-"]) == 0
    assert figures["test_psnr"] == pytest.approx(json.loads(capsys.readouterr().out)["psnr"], abs=1e-4)


def test_the_help_names_the_defaults_that_hold(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The help states the defaults in use, compared without spaces, as lines break inside numbers too."""
    monkeypatch.setenv("COLUMNS", "80")  # a wider help would have two columns
    with pytest.raises(SystemExit):
        train_main(["--help"])
    said = re.sub(r"[\s│]+", "", capsys.readouterr().out)
    cpu, gpu = (TrainConfig().for_device(device, False) for device in ("cpu", "cuda"))
    scenes = TrainConfig().for_device("cuda", True)
    draft, good, best = EFFORT_MINUTES.values()
    assert cpu.grid_rate == gpu.grid_rate
    for text in (
        f"Objects {EVAL_VIEWS[False]}, unbounded scenes {EVAL_VIEWS[True]}, a view of which",
        f"GPU: {gpu.steps:,} (unbounded scenes {scenes.steps:,})",
        f"draft {draft[0]:g} minutes, good {good[0]:g} (unbounded scenes {good[1]:g}), best {best[0]:g},",
        f"GPU {gpu.batch_samples:,}, CPU {cpu.batch_samples:,},",
        f"GPU {gpu.batch_rays:,}, CPU {cpu.batch_rays:,},",
        f"GPU {gpu.max_rays:,}, CPU {cpu.max_rays:,}.",
        f"GPU {gpu.network_rate:g}, as in the paper, CPU {cpu.network_rate:g}.",
        f"Adam learning rate of the hash grids; {cpu.grid_rate:g}.",
        f"paper); {cpu.pilot_steps}, but no more than a quarter of the training.",
        f"objects {cpu.distortion:g}, within a hundredth of the box; unbounded scenes {scenes.distortion:g},",
        f"Seed of every random number. (default: {TrainConfig().seed})",
    ):
        assert text.replace(" ", "") in said, text


def test_trainings_own_score_is_that_of_vfr_eval(small_data: Path, tmp_path: Path) -> None:
    """Training's own score is that of `vfr-eval`. Where an unbounded model stores nothing it shows its
    background, not white. Training has to score over this background too, because the bake counts its losses
    from this score."""
    data = tmp_path / "data"
    shutil.copytree(small_data, data)
    for path in data.rglob("*.png"):
        with Image.open(path) as file:
            picture = over_background(np.asarray(file), np.array([0.1, 0.2, 0.4]))
        Image.fromarray(to_8_bit(picture)).save(path)
    model = tmp_path / "model.pt"
    settings = ["--steps", "30", "--kind", "unbounded", "--batch-rays", "64", "--eval-views", "2", *SMALL]
    assert train_main([str(data), str(model), *settings, "--json", str(tmp_path / "train.json")]) == 0
    assert eval_main([str(model), str(data), "--json", str(tmp_path / "eval.json")]) == 0
    trained, whole = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("train", "eval"))
    assert max(whole["background"]) < 0.9, "white would be no test"
    assert trained["test_views"] == whole["n_views"] == 2 and trained["background"] == whole["background"]
    assert trained["test_psnr"] == pytest.approx(whole["psnr"], abs=1e-4)
    loaded, scores = load_model(model), []
    views = load_scene(data).test
    for camera, photograph in zip(views.cameras, views.images, strict=True):
        rendered = render_image(loaded.field, loaded.sampler, camera, np.array(whole["background"]))
        scores.append(psnr(to_8_bit(rendered) / 255, photograph[..., :3] / 255))
    assert trained["test_psnr"] == pytest.approx(np.mean(scores), abs=1e-4)


def test_eval_has_the_mean_and_every_view(model: Path, small_data: Path, tmp_path: Path) -> None:
    assert eval_main([str(model), str(small_data), "--json", str(tmp_path / "eval.json")]) == 0
    figures = json.loads((tmp_path / "eval.json").read_text())
    assert [view["name"] for view in figures["per_view"]] == ["./test/r_0", "./test/r_1"]
    assert figures["psnr"] == pytest.approx(np.mean([view["psnr"] for view in figures["per_view"]]))
    assert figures["psnr"] > 12
    for key in ("ssim", "psnr_float", "ssim_float"):
        assert figures[key] == pytest.approx(np.mean([view[key] for view in figures["per_view"]]))
    assert 0.2 < figures["ssim"] < 1 and abs(figures["ssim"] - figures["ssim_float"]) < 0.01
    assert figures["lpips"] is None and figures["lpips_network"] is None
    assert (figures["n_views"], figures["background"], figures["bits"]) == (2, [1, 1, 1], 8)


def test_eval_says_the_means_and_shows_the_views(
    model: Path, small_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = tmp_path / "pictures"
    for _ in range(2):  # what an earlier run wrote is replaced
        assert eval_main([str(model), str(small_data), "--pictures", str(pictures)]) == 0
        assert re.search(r" dB mean PSNR, SSIM 0\.\d{4} over 2 test views\n$", capsys.readouterr().out)
    assert sorted(path.name for path in pictures.iterdir()) == ["r_0.png", "r_1.png"]
    with Image.open(pictures / "r_0.png") as file, Image.open(small_data / "test" / "r_0.png") as photograph:
        assert file.size == (3 * 32, 32)
        white = over_background(np.asarray(photograph), np.ones(3))
        assert np.array_equal(np.asarray(file)[:, :32], to_8_bit(white))


def test_eval_refuses_cameras_that_the_model_was_not_trained_with(
    model: Path, small_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = shutil.copytree(small_data, tmp_path / "other")
    for name in ("transforms_train.json", "transforms_test.json"):
        cameras = json.loads((other / name).read_text())
        for frame in cameras["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= 1.1
        (other / name).write_text(json.dumps(cameras))
    assert eval_main([str(model), str(other)]) == 1
    one_error(capsys, f"{other}: cameras: expected those that {model} was trained with", "sparse/")


def test_eval_measures_lpips(
    model: Path,
    small_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`vfr-eval` reports LPIPS, here of a stand-in, as the real weights are large and not ours to keep."""

    class Distance:
        def __init__(self, network: str) -> None:
            self.network = network

        def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
            return 0.125

    monkeypatch.setattr("vfr_bake.training.scores.lpips.Lpips", Distance)
    target = tmp_path / "eval.json"
    assert eval_main([str(model), str(small_data), "--lpips", "vgg", "--json", str(target)]) == 0
    figures = json.loads(target.read_text())
    assert (figures["lpips"], figures["lpips_network"]) == (0.125, "vgg")
    assert [view["lpips"] for view in figures["per_view"]] == [0.125, 0.125]
    assert ", LPIPS (vgg) 0.1250 over 2 test views" in capsys.readouterr().out


def test_eval_says_what_lpips_lacks_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vfr_bake.training.scores.lpips.find_spec", lambda name: None)
    assert eval_main([str(tmp_path / "none.pt"), "nowhere", "--lpips", "alex"]) == 1
    one_error(capsys, "lpips is not installed", "pip install 'vfr-bake[lpips]'")


def test_a_view_without_error_is_null_in_json(
    model: Path, small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def perfect(model: Model, views: PosedImages, masked: bool):
        for camera, image in zip(views.cameras, views.images, strict=True):
            rgb = over_background(image, model.background)
            yield RenderedView(camera.name, rgb, rgb)

    monkeypatch.setattr("vfr_bake.evaluation.render_views", perfect)
    target = tmp_path / "eval.json"
    assert eval_main([str(model), str(small_data), "--json", str(target)]) == 0
    figures = json.loads(target.read_text(), parse_constant=pytest.fail)
    assert figures["psnr"] is None and figures["per_view"][0]["psnr_float"] is None and figures["ssim"] == 1


def test_bake_needs_no_data_set_and_refuses_to_replace(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        str(model),
        str(tmp_path / "asset"),
        "--preset",
        "fidelity",
        "--resolution",
        "48",
        "--refine-steps",
        "50",
    ]
    assert bake_main([*arguments, "--json", str(tmp_path / "bake.json")]) == 0
    figures = json.loads((tmp_path / "bake.json").read_text())
    # After 150 steps the model is half fog, which the photographs do not show and which may be left out.
    assert figures["megabytes"] > 0 and figures["psnr_to_full_model"] > 20
    assert figures["loss_db"] - figures["loss_db_spread"] < 0.1
    assert "vertices" in capsys.readouterr().out
    before = (tmp_path / "asset" / "manifest.json").read_bytes()
    assert bake_main(arguments) == 1
    one_error(capsys, str(tmp_path / "asset"), "already exists", "--force")
    assert (tmp_path / "asset" / "manifest.json").read_bytes() == before
    coarse = [*arguments[:2], "--resolution", "24", "--refine-steps", "0", "--force"]
    capsys.readouterr()
    assert bake_main(coarse) == 0
    assert Asset.open(tmp_path / "asset").manifest.resolution == 24
    said = capsys.readouterr()
    assert "no witnesses" not in said.err and re.search(r"loses -?[\d.]+ dB \(give or take", said.out)
    old = replace(load_model(model), witnesses=None)
    save_model(tmp_path / "old.pt", old)
    assert bake_main([str(tmp_path / "old.pt"), *coarse[1:], "--json", "-"]) == 0
    said = capsys.readouterr()
    assert said.err.count("the model has no witnesses") == 1 and "train again" in said.err
    assert json.loads(said.out)["loss_db_spread"] is None


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["nowhere", "model.pt"], ["nowhere"]),
        (["empty", "model.pt"], ["empty", "transforms"]),
        (["file.txt", "model.pt"], ["file.txt"]),
    ],
)
def test_bad_data_is_one_line(
    arguments: list[str],
    parts: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("file.txt").write_text("not a folder")
    assert train_main(arguments) == 1
    one_error(capsys, *parts)
    assert not Path("model.pt").exists()


def test_a_model_that_exists_is_kept_before_any_work(
    small_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "model.pt").write_bytes(b"precious")
    assert train_main([str(small_data), str(tmp_path / "model.pt")]) == 1
    one_error(capsys, "model.pt", "--force")
    assert (tmp_path / "model.pt").read_bytes() == b"precious"


def test_a_folder_as_model_is_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main([str(tmp_path / "nowhere"), str(tmp_path), "--force"]) == 1
    one_error(capsys, str(tmp_path), "expected a file to write, got a folder")


@pytest.mark.parametrize("command", [bake_main, eval_main])
def test_a_file_that_is_no_model(command, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.pt").write_bytes(b"PK\x03\x04 but not really")
    assert command([str(tmp_path / "model.pt"), str(tmp_path / "out")]) == 1
    one_error(capsys, "model.pt", "not a model file")
    assert not (tmp_path / "out").exists()


def test_a_setting_out_of_range(small_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        train_main([str(small_data), str(tmp_path / "model.pt"), "--minutes", "-1"])
    assert caught.value.code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "minutes: expected more than 0, and at most a million, got -1" in said


def test_a_full_disk_leaves_nothing(
    model: Path,
    small_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert train_main([str(small_data), str(tmp_path / "model.pt"), "--steps", "2", *SMALL]) == 1
    one_error(capsys, "model.pt", "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_usage_is_2() -> None:
    with pytest.raises(SystemExit) as caught:
        train_main(["--no-such-option"])
    assert caught.value.code == 2


@pytest.mark.needs("signals")
def test_ctrl_c_leaves_a_usable_model(small_data: Path, tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    code = "import sys; from player import progress; from vfr_bake import cli"
    code += "; progress.SECONDS_BETWEEN_LINES = 0.2; sys.exit(cli.train_main())"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(small_data), str(path), "--steps", "1000000", *SMALL],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    deadline = time.monotonic() + 120
    while "training" not in process.stderr.readline():
        assert time.monotonic() < deadline and process.poll() is None
    process.send_signal(signal.SIGINT)
    try:
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()
        process.stderr.close()
    assert eval_main([str(path), str(small_data)]) == 0


def test_training_goes_on_after_kill_9(small_data: Path, tmp_path: Path) -> None:
    """A training that is resumed after kill -9 gives the same field, to the last bit, as one left alone."""
    settings = [*SMALL, "--steps", "400", "--minutes", "60", "--eval-views", "0"]
    settings += ["--checkpoint-minutes", "0.005"]
    alone, killed = tmp_path / "alone.pt", tmp_path / "killed.pt"
    assert train_main([str(small_data), str(alone), *settings]) == 0
    program = "import sys; from vfr_bake.cli import train_main; sys.exit(train_main())"
    checkpoint = tmp_path / "killed.pt.checkpoint"
    process = subprocess.Popen([sys.executable, "-c", program, str(small_data), str(killed), *settings])
    end = time.monotonic() + 120
    while not checkpoint.exists() and time.monotonic() < end and process.poll() is None:
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert checkpoint.exists() and not killed.exists()
    assert train_main([str(small_data), str(killed), *settings, "--resume"]) == 0
    assert not checkpoint.exists()
    fields = [load_model(path).field.state_dict() for path in (alone, killed)]
    for name, tensor in fields[0].items():
        assert torch.equal(tensor, fields[1][name]), name


def test_a_training_that_was_complete_already_gives_a_model_that_bakes(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With `--resume` and fewer steps than the checkpoint has, no step is taken; the error is that of the
    complete model."""
    path, asset, kept = tmp_path / "model.pt", tmp_path / "asset", tmp_path / "kept"
    settings = [*SMALL, "--steps", "30", "--eval-views", "0", "--checkpoint-minutes", "1e-6"]

    def keep(target: Path, trainer: Trainer) -> None:
        save_checkpoint(target, trainer)
        shutil.copy(target, kept)

    monkeypatch.setattr("vfr_bake.training.checkpoint.save_checkpoint", keep)
    assert train_main([str(small_data), str(path), *settings]) == 0
    psnr = load_model(path).figures["training_psnr"]
    shutil.copy(kept, checkpoint_path(path))
    settings[settings.index("30")] = "10"
    report = tmp_path / "train.json"
    again = [*settings, "--resume", "--force", "--json", str(report)]
    assert train_main([str(small_data), str(path), *again]) == 0
    assert json.loads(report.read_text())["training_psnr"] == pytest.approx(psnr)
    fast = ["--resolution", "32", "--mesh-resolution", "16", "--check-views", "1", "--refine-steps", "0"]
    assert bake_main([str(path), str(asset), *fast]) == 0


def test_test_views_without_error_are_null_in_json(model: Path, small_data: Path, monkeypatch) -> None:
    monkeypatch.setattr("vfr_bake.evaluation.quick_psnr", lambda *_: ([np.inf], []))
    figures = _test_figures(load_model(model), load_scene(small_data), 1, np.inf)
    assert figures["test_psnr"] is None and figures["test_views"] == 1


def test_an_unbounded_model_is_evaluated_and_always_culled(
    small_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, asset = tmp_path / "model.pt", tmp_path / "asset"
    arguments = ["--steps", "30", "--kind", "unbounded", "--batch-rays", "64", "--downscale", "2", *SMALL]
    assert train_main([str(small_data), str(model), *arguments]) == 0
    assert eval_main([str(model), str(small_data), "--json", str(tmp_path / "eval.json")]) == 0
    assert json.loads((tmp_path / "eval.json").read_text())["n_views"] == 2
    assert bake_main([str(model), str(asset), "--no-cull"]) == 1
    one_error(capsys, "--no-cull: expected the model of an object, got that of an unbounded scene")
    assert not asset.exists()


def test_photographs_without_cameras_have_them_estimated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Photographs without cameras have them estimated, and errors of that are shown."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for index in range(3):
        Image.fromarray(np.full((16, 16, 3), 90 * index, np.uint8)).save(photos / f"{index}.jpg")
    assert train_main([str(photos), str(tmp_path / "model.pt")]) == 1
    one_error(capsys, str(photos))
    calls = []

    def estimate(folder: Path, progress: object, say: object) -> object:
        calls.append(folder)
        raise DataError("found none")

    monkeypatch.setattr("vfr_bake.data.poses.estimate_cameras", estimate)
    assert train_main([str(photos), str(tmp_path / "model.pt")]) == 1
    one_error(capsys, "found none")
    assert train_main([str(photos), str(tmp_path / "model.pt"), "--scale", "x", "y", "1"]) == 1
    one_error(capsys, "scale: x: expected one picture of that name, got none")
    assert calls == [photos]


def test_a_folder_called_demo_is_not_the_built_in_scene(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(small_data, tmp_path / "demo")
    assert [_as_folder(name, print) for name in ("./demo", "demo/", "demo")] == ["./demo", "demo/", "demo"]
    for name in ("transforms_train.json", "transforms_test.json"):
        (tmp_path / "demo" / name).unlink()
    estimated = []

    def estimate(folder: Path, *_: object) -> PoseReport:
        estimated.append(folder)
        return PoseReport(folder, 12, 12, 0.5, 3.0, EstimateRecord(True))

    monkeypatch.setattr("vfr_bake.data.poses.estimate_cameras", estimate)
    for name in ("demo", "./demo"):
        _find_cameras(name, print, None)
    assert estimated == [Path("demo")]


def test_what_is_masked_in_training_is_masked_in_vfr_eval(small_data: Path, tmp_path: Path) -> None:
    """With `--kind unbounded`, transparent pixels are masked, also where the model is evaluated later."""
    model, trained, whole = (tmp_path / name for name in ("model.pt", "train.json", "eval.json"))
    settings = ["--steps", "20", "--kind", "unbounded", "--batch-rays", "64", "--eval-views", "2", *SMALL]
    assert train_main([str(small_data), str(model), *settings, "--json", str(trained)]) == 0
    assert eval_main([str(model), str(small_data), "--json", str(whole)]) == 0
    first, second = (json.loads(path.read_text()) for path in (trained, whole))
    assert first["test_psnr"] == pytest.approx(second["psnr"], abs=1e-4)
    scene = load_scene(small_data)
    assert not scene.masked and any((image[..., 3] == 0).any() for image in scene.test.images)


def test_cameras_that_are_folded_are_told_of(
    small_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pictures whose cameras are folded are named. Finding them is tested elsewhere."""
    monkeypatch.setattr(
        "vfr_bake.data.models.folds.torn_views", lambda _: [("a.jpg", "b.jpg"), ("c.jpg", "d.jpg")]
    )
    steps = ["--steps", "1", "--eval-views", "0"]
    assert train_main([str(small_data), str(tmp_path / "model.pt"), *steps]) == 0
    said = capsys.readouterr().err
    assert "a.jpg and b.jpg, c.jpg and d.jpg match" in said and "the pictures alone" in said


def test_a_disk_that_fills_in_a_temporary_folder_is_one_line(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/tmp/head.onnx")

    monkeypatch.setattr("vfr_bake.baking.bake.unwritten_asset", full)
    settings = ["--resolution", "24", "--refine-steps", "0", "--check-views", "1", "--target-ms", "1000"]
    assert bake_main([str(model), str(tmp_path / "asset"), *settings]) == 1
    one_error(capsys, "vfr-bake: error: /tmp/head.onnx: No space left on device")
    assert not (tmp_path / "asset").exists()
