"""Tests of the scene that comes with the player: `vfr-play demo`."""

from __future__ import annotations

import sys
import tempfile
import webbrowser
from pathlib import Path

import pytest

from player.app import cli
from player.app.option_types import DEMO
from player.asset.asset import Asset, read_manifest
from player.asset.manifest import VERSION
from player.page.page import page


def test_it_is_small_and_whole(capsys: pytest.CaptureFixture[str]) -> None:
    assert sum(path.stat().st_size for path in DEMO.iterdir()) < 3_000_000
    assert cli.main(["demo", "--check"]) == 0
    assert "FAILED" not in capsys.readouterr().out


def test_it_is_baked_as_assets_are_today() -> None:
    """Its bake states what qualities leave out and what parts show, and that it loses next to nothing."""
    manifest = read_manifest(DEMO)
    assert manifest.version == VERSION and manifest.quality_fetches is not None
    baked = manifest.provenance["baked"]
    assert len(baked["parts"]) == len(manifest.parts) - 1
    assert baked["stages"][-1]["loss_db"] < 0.1


def test_a_folder_of_that_name_is_another_asset(
    shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "demo").symlink_to(shells_folder, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    said = []
    for name in ("demo", "./demo"):
        assert cli.main([name, "--info"]) == 0
        said.append(capsys.readouterr().out)
    assert said[0] != said[1]


@pytest.mark.parametrize(("options", "display"), [([], ""), (["--max-memory", "4"], ":0")])
def test_without_the_viewer_its_page_opens(
    options: list[str],
    display: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    opened: list[str] = []
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(webbrowser, "open", opened.append)
    assert cli.main(["demo", *options]) == 0
    (written,) = tmp_path.glob("*/demo.html")
    assert written.read_bytes() == page(Asset.open(DEMO))
    assert opened == ([written.as_uri()] if display else [])
    said = capsys.readouterr()
    assert said.out == f"{written}: open it in any browser\n"
    assert "pip install 'vfr-bake[viewer]'" in said.err


def test_what_its_page_cannot_do_needs_the_viewer(
    shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(webbrowser, "open", lambda address: None)
    for more in (["--threads", "1"], ["--background", "black"], ["--port", "8123"], [str(shells_folder)]):
        assert cli.main(["demo", *more]) == 1
        said = capsys.readouterr()
        assert said.out == "" and "expected the package viser, which is not installed" in said.err
    assert not list(tmp_path.glob("*/demo.html"))
