"""Measure the figures of the README and the manual anew, and render the pages with them: the core set, with
`--all` the rest, too.

    python -m tests.benchmarks                        # the core set: what this commit and machine lack of it
    python -m tests.benchmarks --only bake_lego_fast  # some parts, and before them what they need
    python -m tests.benchmarks --list                 # all parts, and which of them are there
    python -m tests.benchmarks render                 # the pages alone

When a part ends, its result is recorded in docs/benchmarks.json, or in docs/benchmarks_avx512.json if the
processor has AVX-512, so that an interrupted run goes on where it was. Models and assets lie in
build/benchmarks. Each part waits until the machine is quiet, and is measured once more if the machine does
not stay so. Data sets lie in the folder that VFR_DATA names. Linux alone.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from tests.benchmarks.pages.documents import render_all
from tests.benchmarks.suite import conditions
from tests.benchmarks.suite.little import write_data_sets
from tests.benchmarks.suite.parts import PARTS
from tests.benchmarks.suite.results import RESULTS, RESULTS_AVX512, read_results, results_path
from tests.benchmarks.suite.runner import Runner, Settings

BUILD = conditions.REPOSITORY / "build"
DATA = conditions.REPOSITORY.parent / "shared" / "data"


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("action", nargs="?", choices=("run", "render"), default="run")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[*PARTS], help="parts to run")
    parser.add_argument("--all", action="store_true", help="also parts that are not in the core set")
    parser.add_argument("--list", action="store_true", help="say which parts there are, and run none")
    parser.add_argument("--again", action="store_true", help="also run parts whose result is there")
    parser.add_argument("--wait", type=float, default=30, metavar="MINUTES", help="for a quiet machine; 30")
    parser.add_argument(
        "--busy-anyway", action="store_true", help="after that, measure once, beside what else runs"
    )
    parser.add_argument("--quick", action="store_true", help=argparse.SUPPRESS)  # tries out the machinery
    arguments = parser.parse_args()
    if arguments.action == "render":
        return _render()
    commit, machine = conditions.commit(), conditions.machine()
    folder = BUILD / ("benchmarks-quick" if arguments.quick else "benchmarks")
    settings = Settings(folder / commit, Path(os.environ.get("VFR_DATA", DATA)).resolve())
    settings.results = results_path(machine)
    settings.wait, settings.busy_anyway = arguments.wait, arguments.busy_anyway
    settings.again, settings.quick = arguments.again, arguments.quick
    if arguments.quick:
        settings.results, settings.data_root = folder / "benchmarks.json", folder / "data"
        write_data_sets(settings.data_root)
    elif changed := conditions.changed_files():
        print(
            f"benchmarks: expected what is measured as committed, changed: {', '.join(changed)}",
            file=sys.stderr,
        )
        return 1
    names = arguments.only or [name for name, part in PARTS.items() if part.core or arguments.all]
    runner = Runner(PARTS, settings, commit, machine)
    if arguments.list:
        return _list(set(runner.order([*PARTS])))
    conditions.adopt_orphans()
    try:
        failed = runner.run(names)
    except conditions.BusyError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("benchmarks: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    for reason in failed.values():
        print(f"benchmarks: {reason}", file=sys.stderr)
    if not arguments.quick:
        _render()
    return 1 if failed else 0


def _list(missing: set[str]) -> int:
    for name, part in PARTS.items():
        where = "core" if part.core else "more"
        print(f"{name:26} {where}  {part.minutes:5.1f} min  {'to run' if name in missing else 'there'}")
    core = sum(part.minutes for part in PARTS.values() if part.core)
    print(f"the core set takes about {core:.0f} minutes on two cores")
    return 0


def _render() -> int:
    for path in render_all(read_results(RESULTS), read_results(RESULTS_AVX512)):
        print(path.relative_to(conditions.REPOSITORY))
    return 0


if __name__ == "__main__":
    sys.exit(main())
