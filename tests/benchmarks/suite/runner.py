"""Runs parts, each once the parts that it needs are there, and records each as soon as it has ended."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from tests.benchmarks.suite import conditions
from tests.benchmarks.suite.results import RESULTS, read_results, write_results
from tests.benchmarks.suite.work import Part, PartError, Work


@dataclass
class Settings:
    """How parts are run."""

    root: Path
    """The folder of what parts write, of one commit: models and assets are kept there for others."""
    data_root: Path
    results: Path = RESULTS
    quick: bool = False
    again: bool = False
    """Also run parts whose result is there."""
    wait: float = 30.0
    """Minutes to wait at most for a quiet machine, before each part."""
    busy_anyway: bool = False
    """Measure also where other programs keep the machine busy, before a part or during it."""


class Runner:
    """Runs parts on this machine, at this commit."""

    def __init__(
        self, parts: dict[str, Part], settings: Settings, commit: str, machine: dict[str, Any]
    ) -> None:
        self._parts, self._settings = parts, settings
        self._commit, self._machine = commit, machine
        self._failed: dict[str, str] = {}
        self._run: set[str] = set()
        self.quiet: Callable[[], float] = lambda: conditions.wait_until_quiet(
            settings.wait, settings.busy_anyway, _say
        )
        self.settle: Callable[[], object] = conditions.bury_orphans
        self.clock: Callable[[], conditions.OthersClock] = conditions.OthersClock

    def order(self, names: Sequence[str]) -> list[str]:
        """Return the parts to run for `names`, each behind the parts that it needs and that are missing."""
        recorded = read_results(self._settings.results)
        ordered: list[str] = []

        def add(name: str, asked: bool) -> None:
            if name in ordered:
                return
            result = recorded.get(name)
            measured = (
                result is not None and result["commit"] == self._commit and result["machine"] == self._machine
            )
            # Files of a part may be gone, or be another machine's, although its figures are recorded.
            there = measured and (asked or (self._settings.root / name / "whole").exists())
            if there and not (asked and self._settings.again):
                return
            for needed in self._parts[name].needs:
                add(needed, False)
            ordered.append(name)

        for name in names:
            add(name, True)
        return ordered

    def run(self, names: Sequence[str]) -> dict[str, str]:
        """Run the parts, and return which failed and why. Raises BusyError."""
        ordered = self.order(names)
        minutes = sum(self._parts[name].minutes for name in ordered)
        _say(f"parts to run: {len(ordered)}, about {minutes:.0f} minutes on two cores")
        for number, name in enumerate(ordered, start=1):
            part = self._parts[name]
            lacking = [needed for needed in part.needs if needed in self._failed]
            if lacking:
                self._failed[name] = f"{name}: needs {', '.join(lacking)}"
                continue
            _say(f"[{number}/{len(ordered)}] {name}, about {part.minutes:g} minutes")
            try:
                self._one(part)
            except PartError as error:
                self._failed[name] = str(error)
                _say(str(error))
        return self._failed

    def _one(self, part: Part) -> None:
        """Measure a part, once more if other programs disturbed it, and record it. Raises PartError if they
        did so again."""
        result = self._measured(part)
        if self._disturbed(result):
            _say(f"other programs took {result['others']:.0%} of the processors meanwhile: once more")
            result = self._measured(part)
            if self._disturbed(result):
                raise PartError(
                    f"{part.name}: processors: expected other programs to take at most "
                    f"{conditions.QUIET:.0%} of them, got {result['others']:.0%} again: end them, or give "
                    "--busy-anyway"
                )
        (self._settings.root / part.name / "whole").touch()
        path = self._settings.results
        write_results(read_results(path) | {part.name: result}, list(self._parts), path)

    def _disturbed(self, result: dict[str, Any]) -> bool:
        """Return whether other programs changed figures, and that was not asked for."""
        asked = self._settings.busy_anyway or self._settings.quick
        return bool(result["figures"]) and result["others"] > conditions.QUIET and not asked

    def _measured(self, part: Part) -> dict[str, Any]:
        """Wait for a quiet machine, measure a part, and return its result."""
        settings = self._settings
        work = Work(part.name, settings.root, settings.data_root, settings.quick)
        if part.data not in (None, "demo") and not Path(work.data(part.data)).is_dir():
            raise PartError(
                f"{part.name}: {work.data(part.data)}: expected a data set, found none (VFR_DATA)"
            )
        shutil.rmtree(work.folder, ignore_errors=True)
        work.folder.mkdir(parents=True)
        before = 0.0 if settings.quick else self.quiet()
        load_before, clock, begin = os.getloadavg(), self.clock(), time.monotonic()
        figures = part.measure(work)
        self.settle()
        return {
            "commit": self._commit,
            "date": date.today().isoformat(),
            "machine": self._machine,
            "load_before": load_before,
            "load_after": os.getloadavg(),
            "others_before": before,
            "others": clock.share(),
            "libraries": conditions.libraries(),
            "seeds": work.seeds,
            "commands": work.commands,
            "seconds": time.monotonic() - begin,
            "figures": figures,
        }


def _say(text: str) -> None:
    print(f"benchmarks: {text}", file=sys.stderr, flush=True)
