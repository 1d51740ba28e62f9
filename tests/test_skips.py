"""No test is skipped silently: a run fails on any skip that is not explained by what the platform lacks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
NEEDS = "@pytest.mark.needs('signals')\ndef test_it(): raise SystemExit"
SKIPS = {
    "in the test": "def test_it(): pytest.skip('no time')",
    "by a condition": "@pytest.mark.skipif(True, reason='no time')\ndef test_it(): pass",
    "of a package": "pytest.importorskip('no_such_package')\ndef test_it(): pass",
    "expected to fail": "@pytest.mark.xfail(reason='no time')\ndef test_it(): assert False",
}


def run(folder: Path, test: str, more: str = "", *options: str) -> subprocess.CompletedProcess[str]:
    """Run pytest on one test, under the repository's conftest.py with the code `more` appended."""
    shared = (REPOSITORY / "conftest.py").read_text(encoding="utf-8")
    (folder / "conftest.py").write_text(f"{shared}\n{more}\n", encoding="utf-8")
    (folder / "test_it.py").write_text(f"import pytest\n{test}\n")
    (folder / "pytest.ini").write_text("[pytest]\ntestpaths = .\naddopts = -p no:dash -p no:cacheprovider\n")
    command = [sys.executable, "-m", "pytest", "-q", *options]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("way", SKIPS)
def test_a_skip_that_nobody_expects_fails_the_run(way: str, tmp_path: Path) -> None:
    done = run(tmp_path, SKIPS[way], "", "test_it.py")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "a skip that nobody expects: test_it.py" in done.stdout


def test_a_skip_is_seen_from_several_processes(tmp_path: Path) -> None:
    done = run(tmp_path, SKIPS["in the test"], "", "test_it.py", "-n", "2", "--dist", "loadfile")
    assert done.returncode == 1 and "a skip that nobody expects: test_it.py" in done.stdout


def test_what_the_platform_lacks_is_skipped_and_counted(tmp_path: Path) -> None:
    lacking = "LACKING.update(signals=True, open3d=False)"
    done = run(tmp_path, NEEDS, lacking, "test_it.py")
    assert done.returncode == 0 and "1 skipped" in done.stdout
    assert run(tmp_path, NEEDS, f"{lacking}; N_TESTS = {{'signals': 1}}").returncode == 0
    done = run(tmp_path, NEEDS, f"{lacking}; N_TESTS = {{'signals': 2}}")
    assert (
        done.returncode != 0
        and "expected {'signals': 2} as in conftest.py, got {'signals': 1}" in done.stderr
    )
    assert run(tmp_path, "def test_it(): pass", "N_TESTS = {}").returncode == 0
