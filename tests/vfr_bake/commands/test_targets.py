"""Nothing but an earlier result of the same kind is replaced, whatever --force says; the rest is refused
before any work."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from PIL import Image

from player.errors import OutputError
from vfr_bake.cli import bake_main, eval_main, train_main
from vfr_bake.commands.targets import RESULTS, check_json_target, check_model_target, check_page_target
from vfr_bake.training.tensor_files import write_tensors


def one_error(capsys: pytest.CaptureFixture[str], *parts: str) -> None:
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and ": error: " in lines[0], lines
    for part in parts:
        assert part in lines[0]


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "garden"
    folder.mkdir()
    for index in range(3):
        Image.new("RGB", (16, 12), (80 * index, 0, 0)).save(folder / f"IMG_{index}.jpg")
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("convert", [[], ["--convert"]])
def test_a_bake_replaces_no_photographs_and_no_model(
    convert: list[str], photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = content(photographs)
    model = tmp_path / "model.pt"
    model.write_bytes(b"hours of work")
    assert bake_main([*convert, str(model), str(photographs), "--force"]) == 1
    one_error(capsys, "expected no folder, or one of an asset alone, got IMG_0.jpg in it: name another")
    assert content(photographs) == before
    assert bake_main([*convert, str(model), str(model), "--force"]) == 1
    one_error(capsys, "model.pt: expected a folder to write, got a file: name another")
    assert model.read_bytes() == b"hours of work"


def test_training_replaces_no_photograph(photographs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = content(photographs)
    assert train_main([str(photographs), str(photographs / "IMG_1.jpg"), "--force"]) == 1
    one_error(capsys, "IMG_1.jpg: expected a new file or an earlier model, got another file: name a new one")
    assert train_main([str(photographs), "--check", "--html", str(photographs / "IMG_1.jpg"), "--force"]) == 1
    one_error(capsys, "IMG_1.jpg: expected a new file or an earlier page, got another file: name a new one")
    assert content(photographs) == before


@pytest.mark.parametrize("option", ["--force", "--resume"])
def test_a_preview_replaces_no_other_picture(
    option: str, photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preview = tmp_path / "model.preview.png"
    Image.new("RGB", (30, 10)).save(tmp_path / "other.png")
    for data in (b"notes", (tmp_path / "other.png").read_bytes()):
        preview.write_bytes(data)
        assert train_main([str(photographs), str(tmp_path / "model.pt"), "--preview", option]) == 1
        one_error(capsys, "model.preview.png: expected a new file or an earlier preview, got another file")
        assert preview.read_bytes() == data


def test_models_and_pages_are_replaced_with_force_alone(tmp_path: Path) -> None:
    model, page, empty = tmp_path / "model.pt", tmp_path / "page.html", tmp_path / "empty"
    write_tensors(model, {"format": "vfr-model", "state": torch.zeros(3)})
    page.write_text("<!DOCTYPE html><html></html>")
    empty.touch()
    for path, check in ((model, check_model_target), (page, check_page_target)):
        for target in (path, empty):
            check(target, True)
            with pytest.raises(OutputError, match="already exists: add --force"):
                check(target, False)
        check(tmp_path / "new", False)
    write_tensors(tmp_path / "other.pt", {"format": "another program's"})
    for path in (tmp_path / "other.pt", page):
        with pytest.raises(OutputError, match="expected a new file or an earlier model"):
            check_model_target(path, True)
    with pytest.raises(OutputError, match="expected a new file or an earlier page"):
        check_page_target(model, True)
    page.write_text("<!DOCTYPE html>\n<!-- ours -->")
    check_page_target(page, False, "<!-- ours -->")
    with pytest.raises(OutputError, match="already exists: add --force"):
        check_page_target(page, False, "<!-- theirs -->")


COMMANDS = [
    (train_main, ["{data}", "{new}/model.pt", "--json"]),
    (train_main, ["{data}", "--check", "--html", "{new}/page.html", "--json"]),
    (bake_main, ["{new}/model.pt", "{new}/out", "--json"]),
    (bake_main, ["{new}/old", "{new}/out", "--convert", "--json"]),
    (eval_main, ["{new}/model.pt", "{data}", "--json"]),
]


@pytest.mark.parametrize(("command", "arguments"), COMMANDS)
def test_a_result_that_cannot_be_written_is_told_before_any_work(
    command: Callable[[list[str]], int],
    arguments: list[str],
    photographs: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Nothing that is read is there, so that any work would end in another error."""
    words = [word.format(data=tmp_path / "no data", new=tmp_path / "new") for word in arguments]
    assert command([*words, str(tmp_path)]) == 1
    one_error(capsys, f"{tmp_path}: expected a file to write, got a folder: name a file in it")
    photograph = photographs / "IMG_0.jpg"
    assert command([*words, str(photograph / "result.json")]) == 1
    one_error(capsys, "IMG_0.jpg is a file, not a folder")
    for name, data in (("transforms.json", b'{"frames": []}'), ("IMG_0.jpg", photograph.read_bytes())):
        (photographs / name).write_bytes(data)
        assert command([*words, str(photographs / name)]) == 1
        one_error(capsys, f"{name}: --json: expected a new file or an earlier result, got another file")
        assert (photographs / name).read_bytes() == data
    assert not (tmp_path / "new").exists()


def test_a_result_is_written_beside_what_a_command_reads_and_writes(
    shells_folder: Path, tmp_path: Path
) -> None:
    asset, model = Path(shutil.copytree(shells_folder, tmp_path / "out")), tmp_path / "model.pt"
    with pytest.raises(OutputError, match=r"--json: expected another file than .*, which is read"):
        model.touch()
        check_json_target(model, [model], asset)
    for target in (asset / "bake.json", asset):
        with pytest.raises(OutputError):
            check_json_target(target, [model], asset)
    with pytest.raises(OutputError, match=r"expected a file outside .*new, which is written, too"):
        check_json_target(tmp_path / "new" / "bake.json", [], tmp_path / "new")
    with pytest.raises(OutputError, match=r"new\.pt, which is written, too"):
        check_json_target(tmp_path / "new.pt", [], tmp_path / "new.pt")
    with pytest.raises(OutputError, match="expected a file outside the asset"):
        check_json_target(asset / "train.json", [], tmp_path / "new.pt")
    for target in (None, Path("-"), tmp_path / "new.json"):
        check_json_target(target, [model], asset)


@pytest.mark.parametrize("keys", RESULTS, ids=lambda keys: "-".join(sorted(keys)))
def test_an_earlier_result_is_replaced(keys: set[str], tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    for text in ("", json.dumps(dict.fromkeys([*keys, "more"]))):
        path.write_text(text)
        check_json_target(path, [])
        with pytest.raises(OutputError, match="already exists: add --force"):
            check_json_target(path, [], force=False)


def test_views_are_compared_outside_the_data_set(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A data set may have pictures of the names that are written, for example `test/r_0.png`."""
    words = [str(tmp_path / "no model.pt"), str(photographs), "--pictures"]
    for folder in (photographs, photographs / "test"):
        assert eval_main([*words, str(folder)]) == 1
        one_error(capsys, f"{folder}: --pictures: expected a folder outside {photographs}, which is read")
    assert eval_main([*words, str(photographs / "IMG_0.jpg" / "views")]) == 1
    one_error(capsys, "IMG_0.jpg is a file, not a folder")
