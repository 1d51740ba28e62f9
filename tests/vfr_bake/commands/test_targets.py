"""Nothing but an earlier result of the same kind is replaced, whatever --force says; the rest is refused
before any work."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from PIL import Image

from player.errors import OutputError
from vfr_bake.cli import bake_main, train_main
from vfr_bake.commands.targets import check_model_target, check_page_target
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
