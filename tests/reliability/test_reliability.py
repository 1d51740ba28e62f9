"""Short forms of the long scripts: broken inputs, broken messages to the viewer, killed commands, one output
for two commands, full disks."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent.parent


def run(module: str, *arguments: str) -> dict[str, Any]:
    """Run a module in its own process: fuzzed code may crash, and forks need a process without threads."""
    return _answer("-m", module, *arguments)


def run_program(program: str, *arguments: str) -> dict[str, Any]:
    """Run the text of a program in a process of its own."""
    return _answer("-c", program, *arguments)


def _answer(*command: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, *command], cwd=REPOSITORY, capture_output=True, text=True, timeout=600
    )
    assert done.stdout, done.stderr[-2000:]
    return json.loads(done.stdout)


def test_broken_inputs_are_refused_or_read() -> None:
    result = run("tests.reliability.fuzz", "--inputs", "580", "--seed", "7")
    assert result["failures"] == [], result["watched_by"]
    assert result["inputs"] == 580 and len(result["targets"]) == 29
    for counts in result["targets"].values():
        assert counts["refused"] + counts["read"] == 20
        assert counts["refused"] > 5, "inputs that break nothing test nothing"


def test_the_viewer_survives_broken_messages() -> None:
    result = run("tests.reliability.fuzz.viewer", "--inputs", "3600", "--seed", "7")
    assert result["failures"] == []
    assert result["messages"] == 3600 and result["connections"] > 6, "some were dropped, and came back"


def test_what_is_killed_leaves_the_old_or_the_new() -> None:
    result = run(
        *("tests.reliability.kill", "--commands", "play", "export", "--runs", "4", "--twice", "1"),
        *("--limits", "300"),
    )
    assert result["failures"] == []
    assert sum(counts["runs"] for counts in result["killed"].values()) == 4
    assert sum(counts["killed"] for counts in result["killed"].values()) >= 1
