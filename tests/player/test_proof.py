"""Tests that compiled code is proven by a process of its own before it is used, and not used if wrong."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from player import kept_code, proof
from player.app.cli import main
from player.asset.asset import Asset
from player.cameras.transforms import read_cameras
from player.compiled import march as march_compiled
from player.errors import MissingExtraError
from player.head import proof as proof_head
from player.march import march
from player.render import Renderer, choose_march

DIES = "import os; os.abort()"
WRONG = "print('wrong: 2 where 6 is right')"


@pytest.fixture(autouse=True)
def nothing_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(kept_code.config, "CACHE_DIR", str(tmp_path / "told"))
    monkeypatch.setattr(proof, "_verdicts", {})
    kept_code.place.cache_clear()
    yield
    kept_code.place.cache_clear()


def child_runs(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    monkeypatch.setattr(proof, "python_command", lambda _: [sys.executable, "-I", "-c", program])


def lines() -> list[str]:
    said: list[str] = []
    proof.prove(said.append)
    return said


def test_this_machine_s_code_is_right_and_asked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert proof.verdict() == proof.RIGHT
    child_runs(monkeypatch, f"print({proof.RIGHT!r})")
    assert lines() == [] and not proof.refuted()
    child_runs(monkeypatch, DIES)
    monkeypatch.setattr(proof, "_verdicts", {})  # as in another process
    assert lines() == [] and not proof.refuted()


@pytest.mark.parametrize(("child", "reason"), [(DIES, "SIGABRT"), (WRONG, "2 where 6 is right")])
def test_wrong_code_is_left(
    child: str, reason: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str],
    shells_folder: Path, tmp_path: Path,
) -> None:  # fmt: skip
    child_runs(monkeypatch, child)
    asset = Asset.open(shells_folder)
    camera = read_cameras(shells_folder / "cameras.json")[0]
    with Renderer(asset) as renderer:
        assert renderer.march == "numba"
        expected = renderer.render(camera)
    assert main([str(shells_folder), "--view", "0", "--output", str(tmp_path / "out"), "--json", "-"]) == 0
    out, err = capfd.readouterr()
    (line,) = err.strip().splitlines()
    assert line.startswith("vfr-play: compiled code does not run on this processor") and reason in line
    assert '"march": "numpy"' in out
    assert proof.refuted() and choose_march("auto") == ("numpy", march)
    with Renderer(asset) as renderer:
        assert renderer.march == "numpy"
        assert np.abs(renderer.render(camera).rgb - expected.rgb).max() < 1 / 255
    with pytest.raises(MissingExtraError, match="got some that does not"):
        choose_march("numba")
    child_runs(monkeypatch, "raise SystemExit('asked again')")
    monkeypatch.setattr(proof, "_verdicts", {})
    assert len(lines()) == 1 and proof.refuted()


@pytest.mark.parametrize(
    "child", ["raise ImportError('no numba here')", "import os, signal; os.kill(os.getpid(), 9)"]
)
def test_a_process_that_could_not_say_anything_says_nothing(
    child: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    child_runs(monkeypatch, child)
    assert lines() == [] and not proof.refuted() and not proof._verdicts
    assert choose_march("auto") == ("numba", march_compiled)


def test_numpy_alone_asks_nobody(
    monkeypatch: pytest.MonkeyPatch, shells_folder: Path, tmp_path: Path
) -> None:
    monkeypatch.setattr(subprocess, "run", None)
    assert (
        main([str(shells_folder), "--march", "numpy", "--view", "0", "--output", str(tmp_path / "out")]) == 0
    )


def careless(module: Any, name: str, change: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    inner = getattr(module, name)

    def changed(*arguments: Any) -> Any:
        got = inner(*arguments)
        return change(got, *arguments)

    monkeypatch.setattr(module, name, changed)


def test_what_is_wrong_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def one_off(got: Any, *_: Any) -> Any:
        got.features[3, 1] += 0.5
        return got

    def write_one(got: Any, memory: np.ndarray, *_: Any) -> None:
        memory[-5] += 1

    def write_another(got: Any, codes: np.ndarray, memory: np.ndarray, *_: Any) -> None:
        memory[7] += 0.5

    with monkeypatch.context() as patch:
        careless(march_compiled, "march", one_off, patch)
        assert proof.verdict() == "wrong: the march gives other pictures than numpy"
    with monkeypatch.context() as patch:
        careless(proof_head, "_floats", write_one, patch)
        assert proof.verdict() == "wrong: a layer gives other sums than numpy"
    if proof_head.MULTIPLIES_BYTES:
        careless(proof_head, "_bytes", write_another, monkeypatch)
        assert proof.verdict() == "wrong: products of bytes are others than numpy's"


if os.name == "posix":

    def test_a_folder_that_others_may_write_to_is_named(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        child_runs(monkeypatch, f"print({proof.RIGHT!r})")
        (tmp_path / "told").mkdir()
        (tmp_path / "told").chmod(0o777)
        (line,) = lines()
        assert f"{tmp_path / 'told'}: expected a folder that nobody else may write to" in line


@pytest.mark.parametrize(("code", "deadly"), [(0xC0000005, True), (3, True), (0, False), (0xC000013A, False)])
def test_on_windows_ctrl_c_says_nothing_about_the_code(
    code: int, deadly: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    assert (proof._deadly(code) is not None) == deadly
