"""The rehearsal: the bake of a tiny model that compiles a bake's code ahead of time."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from vfr_bake import demo, rehearsal
from vfr_bake.baking.bake import bake
from vfr_bake.baking.report import BakeResult


def test_a_rehearsal_stores_and_refines_as_a_bake_does_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    baked: list[BakeResult] = []
    monkeypatch.setattr(rehearsal, "bake", lambda *arguments: baked.append(bake(*arguments)))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(os, "nice", lambda _: None)  # keeps the priority of the tests that follow
    rehearsal.main()
    (result,) = baked
    stages = {stage["name"] for stage in result.figures["stages"]}
    assert stages >= {"grid", "rank", "codes", "small head", "refined", "k", "head in 8 bits", "files"}
    assert {"densities' detail", "features' detail", "hardly seen"} <= set(result.figures["left_out"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("compiled", [False, True])
def test_what_compiles_beside_training_ends_with_it_and_leaves_nothing(
    compiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Popen(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options | {"stdout": subprocess.PIPE})
            started.append(self)

    monkeypatch.setattr("vfr_bake.baking.plan.is_compiled", lambda: compiled)
    program = "import tempfile, time; tempfile.mkdtemp(); print(flush=True); time.sleep(600)"
    command = [sys.executable, "-c", program]
    monkeypatch.setattr(demo, "python_command", lambda _: command)
    monkeypatch.setattr(subprocess, "Popen", Popen)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(KeyboardInterrupt), demo.bake_compiled_beside():
        assert [process.poll() for process in started] == ([] if compiled else [None])
        for process in started:
            assert process.stdout is not None and process.stdout.readline()
            process.stdout.close()
            assert len(list(tmp_path.glob("*/*"))) == 1
        raise KeyboardInterrupt
    assert all(process.returncode is not None for process in started)
    assert not list(tmp_path.iterdir())
