"""What is kept of compiled code."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from player import compiling

USER = """
from pathlib import Path
import player.compiling as compiling
compiling.forget_outdated(Path(__file__).parent)
from other import part

@compiling.compiled
def whole():
    return part() + 1

print(whole())
"""
PART = """
from player.compiling import compiled

@compiled
def part():
    return {}
"""


def run(folder: Path) -> str:
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, str(folder / "user.py")], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def kept(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("__pycache__/*.nbi")}


def test_first_use_is_known_by_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "__file__", str(tmp_path / "compiling.py"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    assert compiling.first_use()
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__" / "march_compiled._march_rays-33.py311.nbi").touch()
    assert not compiling.first_use()


def test_a_change_in_another_file_is_compiled(tmp_path: Path) -> None:
    """numba alone answers 2 the third time."""
    (tmp_path / "user.py").write_text(USER)
    (tmp_path / "other.py").write_text(PART.format(1))
    assert run(tmp_path) == "2"
    first = kept(tmp_path)
    assert first and run(tmp_path) == "2" and kept(tmp_path) == first  # nothing is compiled again
    (tmp_path / "other.py").write_text(PART.format(5))
    assert run(tmp_path) == "6"


@pytest.mark.parametrize("years", [-1, 1])
def test_a_clock_that_was_wrong_does_no_harm(years: int, tmp_path: Path) -> None:
    """Sources from next year are compiled once, not at every start; older ones than what is kept are seen."""
    (tmp_path / "user.py").write_text(USER)
    (tmp_path / "other.py").write_text(PART.format(1))
    assert run(tmp_path) == "2"
    (tmp_path / "other.py").write_text(PART.format(5))
    then = time.time() + years * 365 * 86400
    os.utime(tmp_path / "other.py", (then, then))
    assert run(tmp_path) == "6"
    first = kept(tmp_path)
    assert run(tmp_path) == "6" and kept(tmp_path) == first
