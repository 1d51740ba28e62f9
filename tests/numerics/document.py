"""Writes docs/numerics.md from the rows that tests declare and the worst errors that they have met, and notes
beside new errors in docs/numerics.json at which commit and on which processor they were met.

<!-- numerics: SECTION -->
the table of the rows of this section
<!-- /numerics -->
"""

from __future__ import annotations

import importlib
import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.benchmarks.suite import conditions
from tests.numerics.bounds import Met, Row, write

REPOSITORY = Path(__file__).resolve().parent.parent.parent
PAGE = REPOSITORY / "docs" / "numerics.md"
WORST = PAGE.with_suffix(".json")
BLOCK = re.compile(r"(<!-- numerics: ([^>]+) -->\n).*?(<!-- /numerics -->)", re.DOTALL)
DECLARES = re.compile(r"^[A-Z][A-Z0-9_]* = Row\(", re.MULTILINE)
HEADER = (
    "| quantity | range | bound | worst met | at its ends | test |",
    "|---|---|---|---|---|---|",
)
RUNS = "where the errors were met"
"""Name of the block that is no section: the commits and processors of the errors."""


def modules() -> list[str]:
    """Return the names of the test modules that declare rows."""
    paths = sorted((REPOSITORY / "tests").rglob("test_*.py"))
    found = [path for path in paths if DECLARES.search(path.read_text(encoding="utf-8"))]
    return [".".join(path.relative_to(REPOSITORY).with_suffix("").parts) for path in found]


def declared() -> dict[str, list[tuple[str, Row]]]:
    """Return, for each module, the names and rows that it declares, in its order."""
    return {
        module: [
            (name, row) for name, row in vars(importlib.import_module(module)).items() if isinstance(row, Row)
        ]
        for module in modules()
    }


def line(row: Row, tests: dict[str, dict]) -> str:
    """Return a row as a line of the table.

    >>> entry = {"tests/numerics/test_rays.py::test_entry": {"worst": 2.512, "case": "along x"}}
    >>> line(Row("Rays", "entry", "any", 8, "u", "exact"), entry)
    '| entry | any | 8 u | 2.5 (`along x`) | exact | `tests/numerics/test_rays.py`: `test_entry` |'
    """
    bound = row.unit if row.bound is None else f"{row.bound:.4g} {row.unit}".strip() if row.bound else "exact"
    numbers = [entry for entry in tests.values() if entry["worst"] is not None]
    met = ""
    if numbers:
        worst = max(numbers, key=lambda entry: entry["worst"])
        met = f"{worst['worst']:.2g}" + (f" (`{worst['case']}`)" if worst["case"] and worst["worst"] else "")
    names: dict[str, list[str]] = {}
    for test in sorted(tests):
        path, _, name = test.partition("::")
        names.setdefault(path, []).append(f"`{name}`")
    where = "; ".join(f"`{path}`: {', '.join(found)}" for path, found in names.items())
    return f"| {row.quantity} | {row.range} | {bound} | {met} | {row.at_ends} | {where} |"


def entries(met: Met) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each test's name and the error that it has met, once for each quantity."""
    for rows in met.values():
        for tests in rows.values():
            yield from tests.items()


def stamp(met: Met, commit: str, processor: str) -> None:
    """Note commit and processor in each entry that has none."""
    for _, entry in entries(met):
        if "commit" not in entry:
            entry.update(commit=commit, processor=processor)


def runs(met: Met) -> list[str]:
    """Return the lines of the table of commits and processors.

    >>> entry = {"worst": 0.0, "case": "", "commit": "0a1b2c3", "processor": "AMD EPYC"}
    >>> runs({"Rays": {"entry": {"a": entry, "b": entry}}})[2:]
    ['| AMD EPYC | 0a1b2c3 | 2 |']
    """
    counts = Counter((entry["processor"], entry["commit"]) for _, entry in entries(met))
    lines = [f"| {processor} | {commit} | {n} |" for (processor, commit), n in sorted(counts.items())]
    return ["| processor | commit | errors |", "|---|---|---|", *lines]


def rendered(text: str, rows: list[Row], met: Met) -> str:
    """Return the page with its tables made anew."""

    def block(found: re.Match[str]) -> str:
        if found[2] == RUNS:
            return "\n".join([found[1], *runs(met), "", found[3]])
        lines = [
            line(row, met.get(row.section, {}).get(row.quantity, {}))
            for row in rows
            if row.section == found[2]
        ]
        return "\n".join([found[1], *HEADER, *lines, "", found[3]])

    return BLOCK.sub(block, text)


def read_worst() -> Met:
    return json.loads(WORST.read_text(encoding="utf-8"))


def main() -> None:
    rows, met = [row for found in declared().values() for _, row in found], read_worst()
    changed = " and changes" if conditions.changed_files() else ""
    stamp(met, conditions.commit() + changed, conditions.machine()["processor"])
    write(WORST, met)
    PAGE.write_text(rendered(PAGE.read_text(encoding="utf-8"), rows, met), encoding="utf-8")


if __name__ == "__main__":
    main()
