"""Tests of what an interrupted run leaves, and of how a resumed one goes on."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Literal, NoReturn

import pytest

from player.app import cli
from player.app.options import PlaySettings
from player.app.play import play
from player.asset.asset import Asset
from player.cameras.views import asset_cameras
from player.errors import ConfigError, OutputError
from player.files.images import read_key
from tests.player.app.test_play import decode, trained
from tests.player.conftest import write_shells
from tests.player.in_parts import write_in_parts

REPOSITORY = Path(__file__).resolve().parents[3]


def test_resume_renders_what_is_missing_and_nothing_else(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "o"
    command = [*trained(shells_folder), "--output", str(out), "--resume", "--json", "-"]
    assert cli.main([*trained(shells_folder), "--output", str(tmp_path / "whole")]) == 0
    assert cli.main([*trained(shells_folder), "--output", str(out), "--frames", "1:3"]) == 0
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    capsys.readouterr()
    assert cli.main(command) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 3
    for path in (tmp_path / "whole").iterdir():
        assert (out / path.name).read_bytes() == path.read_bytes()
    assert {name: (out / name).stat().st_mtime_ns for name in before} == before
    assert cli.main(command) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["frames"] == 0 and figures["ms_median"] is None
    assert cli.main(command[:-2]) == 0
    assert "0 pictures (5 were there already)" in capsys.readouterr().out


@pytest.mark.parametrize("options", [["--background", "black"], ["--samples", "2"], ["--size", "24x20"]])
def test_resume_does_not_mix_two_runs(
    options: list[str], shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "o"
    assert cli.main([*trained(shells_folder), "--output", str(out), "--frames", "1:3"]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert cli.main([*trained(shells_folder), "--output", str(out), "--resume", *options]) == 1
    assert "r_1.png: --resume: expected a frame of this asset, these views" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_resume_replaces_no_stranger(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "o"
    out.mkdir()
    (out / "r_1.png").write_text("mine")
    assert cli.main([*trained(shells_folder), "--output", str(out), "--resume"]) == 1
    assert "r_1.png: --resume: expected a frame" in capsys.readouterr().err
    assert (out / "r_1.png").read_text() == "mine" and len(list(out.iterdir())) == 1


def test_resume_does_not_mix_an_incomplete_copy_with_the_whole_asset(tmp_path: Path) -> None:
    folder = write_in_parts(tmp_path / "asset")
    some, whole = Asset.open(folder, parts=1), Asset.open(folder)
    cameras = [camera.resized(24, 20) for camera in asset_cameras(whole)[:2]]
    settings = PlaySettings(tmp_path / "o", march="numpy")
    again = replace(settings, resume=True)
    for first, second in ((some, whole), (whole, some)):
        play(first, cameras, replace(settings, force=True))
        assert play(first, cameras, again).n_kept == 2
        with pytest.raises(ConfigError, match="--resume: expected a frame of this asset"):
            play(second, cameras, again)


@pytest.mark.extra
@pytest.mark.parametrize("march", ["auto", "numba"])
def test_resume_does_not_mix_the_frames_of_two_marches(
    march: Literal["auto", "numba"], asset: Asset, tmp_path: Path
) -> None:
    """They differ by rounding. What counts is the march that is used, not how it was asked for."""
    cameras = [camera.resized(24, 20) for camera in asset_cameras(asset)[:2]]
    slow = PlaySettings(tmp_path / "o", march="numpy")
    play(asset, cameras, slow)
    with pytest.raises(ConfigError, match="--resume: expected a frame of this asset"):
        play(asset, cameras, replace(slow, march=march, resume=True))
    play(asset, cameras, replace(slow, march="numba", force=True))
    assert play(asset, cameras, replace(slow, march=march, resume=True)).n_kept == 2


def test_frames_are_known_by_the_asset_that_was_opened(broken_folder: Path, tmp_path: Path) -> None:
    """Frames of an asset that another has replaced on the disk meanwhile are not taken for frames of that."""
    opened = Asset.open(broken_folder)
    cameras = [camera.resized(24, 20) for camera in asset_cameras(opened)[:2]]
    shutil.rmtree(broken_folder)
    write_shells(broken_folder, sign=-1)
    settings = PlaySettings(tmp_path / "o", march="numpy")
    play(opened, cameras, settings)
    assert play(opened, cameras, replace(settings, resume=True)).n_kept == 2
    with pytest.raises(ConfigError, match="--resume: expected a frame of this asset"):
        play(Asset.open(broken_folder), cameras, replace(settings, resume=True))


def test_resume_goes_on_after_frames_were_being_replaced(
    asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With force, the frames of an earlier run are removed once the first new one is there."""
    cameras = [camera.resized(24, 20) for camera in asset_cameras(asset)]
    first = PlaySettings(tmp_path / "o", samples=1, march="numpy")
    play(asset, cameras, first)
    before = {path.name: path.read_bytes() for path in (tmp_path / "o").iterdir()}

    def interrupted(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    again = replace(first, samples=2, force=True)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("player.app.play.render_job", interrupted)
        play(asset, cameras, again)
    assert {path.name: path.read_bytes() for path in (tmp_path / "o").iterdir()} == before
    with pytest.raises(KeyboardInterrupt):
        play(asset, cameras, again, advance=interrupted)
    assert [path.name for path in (tmp_path / "o").iterdir()] == ["r_0.png"]
    assert play(asset, cameras, replace(again, force=False, resume=True)).n_kept == 1


def test_replacing_frames_removes_no_folder_of_a_frames_name(asset: Asset, tmp_path: Path) -> None:
    (tmp_path / "r_1.png").mkdir()
    (tmp_path / "r_1.png" / "mine").touch()
    cameras = [camera.resized(24, 20) for camera in asset_cameras(asset)[:2]]
    with pytest.raises(OutputError, match=r"r_1\.png: cannot write"):
        play(asset, cameras, PlaySettings(tmp_path, force=True, march="numpy"))
    assert (tmp_path / "r_1.png" / "mine").exists()


@pytest.mark.parametrize("name", ["frames", pytest.param("turn.mp4", marks=pytest.mark.extra)])
def test_ctrl_c_in_the_middle_then_resume(name: str, shells_folder: Path, tmp_path: Path) -> None:
    """A process that is interrupted midway keeps its finished frames; --resume renders only the others."""
    target = tmp_path / name
    folder = target if name == "frames" else tmp_path / "turn.mp4.frames"
    command = [str(shells_folder), "--orbit", "200", "--size", "96x96", "--output", str(target)]
    process = subprocess.Popen(
        [sys.executable, "-m", "player", *command],
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (folder.is_dir() and len(list(folder.glob("orbit_*.png"))) >= 3):
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    assert process.returncode == 130
    assert errors == (
        f"vfr-play: interrupted; the frames that were finished are kept in {folder}; --resume goes on\n"
    )
    done = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert 3 <= len(done) < 200 and all(path.startswith("orbit_") for path in done), "no half written file"
    assert all(read_key(folder / path) for path in done)
    if name != "frames":
        assert not target.exists()
    assert cli.main([*command, "--resume", "--json", str(tmp_path / "figures.json")]) == 0
    assert json.loads((tmp_path / "figures.json").read_text())["frames"] == 200 - len(done)
    if name == "frames":
        assert len(list(folder.iterdir())) == 200
        assert {path: (folder / path).stat().st_mtime_ns for path in done} == done
    else:
        assert len(decode(target)) == 200 and not folder.exists()
