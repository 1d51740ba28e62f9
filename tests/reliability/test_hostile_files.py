"""Every hostile asset, opened by the real commands, gives one line and exit code 1, within the budget."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.reliability.hostile_files import BUDGET, RECIPES

REPOSITORY = Path(__file__).resolve().parents[2]
MESH = "export of the mesh"
"""Command that never succeeds, because the small asset has no valid mesh."""
READ = {
    "a terabyte of mesh, vouched for": {"info", "play"},
    "text that a terminal obeys": {"info", "check", "play", "export", "export of the mesh"},
    "text that a terminal obeys, in a message": {"check"},
}
"""Commands that read a hostile asset all the same."""


def run(asset: Path, output: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.reliability.hostile_files", str(asset), str(output)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def usual(shells_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> float:
    """Peak memory in MB of the commands for an intact asset."""
    results = run(shells_folder, tmp_path_factory.mktemp("usual"))
    peak = results.pop("peak_mb")
    assert [result["code"] for name, result in results.items() if name != MESH] == [0] * 4
    return peak


@pytest.mark.parametrize("recipe", RECIPES)
def test_one_line_within_the_budget(recipe: str, shells_folder: Path, usual: float, tmp_path: Path) -> None:
    broken = Path(shutil.copytree(shells_folder, tmp_path / "broken"))
    RECIPES[recipe](broken)
    output = tmp_path / "output"
    output.mkdir()
    results = run(broken, output)
    assert results.pop("peak_mb") < usual + BUDGET * 1000
    for name, result in results.items():
        assert all(c.isprintable() for line in result["out"].split("\n") for c in line), result["out"]
        if name in READ.get(recipe, set()):
            assert result["code"] == 0 and result["err"] == ""
            continue
        line = result["err"].removesuffix("\n")
        assert result["code"] == 1 and ": error: " in line
        assert line.isprintable() and len(line) < 1000
    if recipe not in READ:
        assert list(output.iterdir()) == []
