"""What the tests and the examples in docstrings share: guarded arrays, a small asset, to be opened as "out/"
in the latter, and which tests may be skipped."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections import Counter
from pathlib import Path

import pytest

# Before player is imported, here and in every process that a test starts: compiled code that writes beside
# its arrays is found out (`player.scratch`).
os.environ["VFR_CANARIES"] = "1"

LACKING = {
    "programs": not (sys.platform == "linux" and platform.machine() == "x86_64"),
    "open3d": sys.platform == "darwin" and platform.machine() == "x86_64",
    "signals": os.name == "nt",
    "forks": not hasattr(os, "fork"),
}
"""What this platform does not have: the programs that `make` installs from Debian's or Ubuntu's packages,
Open3D where pyproject.toml does not ask for it, Ctrl-C that is sent to a process, and processes that are
copies of another."""
LONGEST = (
    "tests/vfr_bake/baking/test_bake.py",
    "tests/player/compiled/test_processor.py",
    "tests/test_real_scene.py",
    "tests/test_real_data.py",
    "tests/vfr_bake/data/models/test_folds.py",
    "tests/vfr_bake/training/test_trainer.py",
    "tests/vfr_bake/test_cli.py",
    "tests/vfr_bake/training/test_devices.py",
    "tests/reliability/test_reliability.py",
    "tests/vfr_bake/training/test_processes.py",
    "tests/player/page/test_renderer.py",
    "tests/player/viewer/test_viewer.py",
    "tests/test_current_folder.py",
)
"""Files that take longest, begun first: no worker is then left alone with one of them at the end. The first
two are begun at the same time, in a clean checkout before anything is compiled: the second compiles for other
processors, so that they do not both compile the same."""
N_TESTS = {"programs": 13, "open3d": 47, "signals": 1, "forks": 2}
"""Tests marked `needs(...)`: so many are skipped where that is lacking, and no other test anywhere."""


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", "needs(what): skipped on the platforms where conftest.py knows it lacks"
    )
    config.pluginmanager.register(Skips(config), "vfr-skips")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    paths = [item.path.relative_to(config.rootpath).as_posix() for item in items]
    place = {path: LONGEST.index(path) if path in LONGEST else len(LONGEST) for path in paths}
    order = sorted(range(len(items)), key=lambda i: place[paths[i]])
    items[:] = [items[i] for i in order]
    counts: Counter[str] = Counter()
    for item in items:
        for what in {mark.args[0] for mark in item.iter_markers("needs")}:
            counts[what] += 1
            if LACKING[what]:
                item.add_marker(pytest.mark.skip(reason=reason_of(what)))
    if is_whole(config) and dict(counts) != N_TESTS:
        raise pytest.UsageError(
            f"tests marked needs(...): expected {N_TESTS} as in conftest.py, got {dict(counts)}"
        )


def reason_of(what: str) -> str:
    """As the report of a skipped test has it."""
    return f"this platform lacks {what}"


def is_whole(config: pytest.Config) -> bool:
    """Whether all tests are run, and not some."""
    options = config.option
    some = options.keyword or options.markexpr or options.deselect or getattr(options, "lf", False)
    return config.args_source == pytest.Config.ArgsSource.TESTPATHS and not some


class Skips:
    """Counts tests that are skipped or expected to fail; where that is not what this platform is known to
    lack, the run fails."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._skipped: list[tuple[str, str]] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.outcome == "skipped":
            self._note(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.outcome == "skipped":
            self._note(report)

    def _note(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        said = report.longrepr
        reason = said[2] if isinstance(said, tuple) else getattr(report, "wasxfail", str(said))
        self._skipped.append((report.nodeid, str(reason).removeprefix("Skipped: ")))

    def _complaints(self) -> list[str]:
        expected = {reason_of(what) for what, lacking in LACKING.items() if lacking}
        found = [f"{test}: {why}" for test, why in self._skipped if why not in expected]
        n = sum(N_TESTS[what] for what, lacking in LACKING.items() if lacking)
        if is_whole(self._config) and len(self._skipped) != n:
            found.append(f"skipped tests: expected {n} on this platform, got {len(self._skipped)}")
        return found

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        done = session.exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
        if done and self._complaints() and not hasattr(session.config, "workerinput"):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for complaint in self._complaints():
            terminalreporter.write_line(f"a skip that nobody expects: {complaint}", red=True)


@pytest.fixture(scope="session")
def shells_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An analytic asset; do not change it, take `broken_folder` for that."""
    from tests.player.conftest import write_shells

    return write_shells(tmp_path_factory.mktemp("assets") / "shells")


@pytest.fixture(autouse=True)
def asset_of_examples(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Examples that open "out/" find the asset there."""
    node = request.node
    if isinstance(node, pytest.DoctestItem) and node.dtest is not None and '"out/' in node.dtest.docstring:
        folder = tmp_path_factory.mktemp("example")
        shutil.copytree(request.getfixturevalue("shells_folder"), folder / "out")
        request.getfixturevalue("monkeypatch").chdir(folder)
