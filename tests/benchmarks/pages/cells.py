"""Cells, rows and tables in Markdown, and lines in place of missing figures."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from tests.benchmarks.suite.conditions import QUIET
from tests.benchmarks.suite.parts import PARTS
from tests.benchmarks.suite.results import Results

Block = Callable[[Results], list[str]]
"""Function that makes the lines of a block from the results."""


def table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table.

    >>> table(["a", "b"], [["1", "2"]])
    ['| a | b |', '|---|---|', '| 1 | 2 |']
    """
    lines = [f"| {' | '.join(row)} |" for row in (titles, *rows)]
    return [lines[0], f"|{'---|' * len(titles)}", *lines[1:]]


def number(value: float | None, digits: int) -> str:
    """Return a number with so many digits behind the point, or "" for None.

    >>> number(1234.56, 1), number(None, 1), number(-0.004, 2)
    ('1,234.6', '', '0.00')
    """
    if value is None:
        return ""
    text = f"{value:,.{digits}f}"
    return text if float(text.replace(",", "")) else text.lstrip("-")


def give_or_take(value: float | None, uncertainty: float | None, digits: int) -> str:
    """Return a number with its uncertainty, if that is known.

    >>> give_or_take(12.34, 0.26, 1), give_or_take(12.34, None, 1)
    ('12.3 ± 0.3', '12.3')
    """
    if value is None or uncertainty is None:
        return number(value, digits)
    return f"{number(value, digits)} ± {number(uncertainty, digits)}"


def rate(ms: float, uncertainty: float) -> str:
    """Return the frames a second, from milliseconds a frame.

    >>> rate(80, 2), rate(700, 7)
    ('12.5 ± 0.3', '1.43 ± 0.01')
    """
    a_second = 1000 / ms
    digits = 0 if a_second >= 100 else 1 if a_second >= 10 else 2
    return give_or_take(a_second, a_second * uncertainty / ms, digits)


def duration(seconds: float) -> str:
    """Return a duration in seconds, or in minutes from 300 s on.

    >>> duration(59.6), duration(600), duration(0.04)
    ('60 s', '10.0 min', '0.04 s')
    """
    if seconds >= 300:
        return f"{seconds / 60:.1f} min"
    return (
        f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1g} s" if seconds < 0.1 else f"{seconds:.1f} s"
    )


def megabytes(n_bytes: float) -> str:
    """Return megabytes, without digits behind the point from 100 MB on.

    >>> megabytes(4.94e6), megabytes(143.2e6)
    ('4.9', '143')
    """
    return f"{n_bytes / 1e6:.{1 if n_bytes < 1e8 else 0}f}"


def gigabytes(mb: float) -> str:
    return f"{mb / 1000:.1f} GB"


def lettered(*files: Results) -> list[Results]:
    """Return files of results whose parts also have their machine's letter: A for the machine of the first
    part, and the next letter for each machine that was not met before."""
    met: list[dict[str, Any]] = []
    found: list[Results] = []
    for results in files:
        for part in results.values():
            if part["machine"] not in met:
                met.append(part["machine"])
        found.append({n: p | {"letter": chr(ord("A") + met.index(p["machine"]))} for n, p in results.items()})
    return found


def machines(results: Results) -> dict[str, dict[str, Any]]:
    """Return the machines of all parts by their letters."""
    found = {part["letter"]: part["machine"] for part in results.values()}
    return {letter: found[letter] for letter in sorted(found)}


def where(results: Results, name: str) -> str:
    """Return machine and commit of a part, with * if other programs took more than counts as quiet beside it,
    or (*) beside a part that it was made from: trainings and bakes then take fewer steps in equal time."""
    part = results[name]
    busy = [max(some["others"], some["others_before"]) > QUIET for some in _part_and_sources(results, name)]
    beside = "*" if busy[0] else "(*)" if any(busy) else ""
    return f"{part['letter']}{beside}, {part['commit'][:7]}"


def _part_and_sources(results: Results, name: str) -> Iterator[dict[str, Any]]:
    """Yield a part, and then those of the same machine that its files were made from."""
    part = results[name]
    yield part
    for need in PARTS[name].needs:
        if need != "compiled" and need in results and results[need]["letter"] == part["letter"]:
            yield from _part_and_sources(results, need)


def measured_on(results: Results, names: Sequence[str]) -> list[str]:
    """Return a blank line and a line with machines and commits, for tables without a column for these."""
    places = list(dict.fromkeys(where(results, name) for name in names))
    return ["", f"Machine and commit: {'; '.join(places)}."] if places else []


def present(results: Results, names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return the parts that have results, and those that have none."""
    names = list(names)
    return [name for name in names if name in results], [name for name in names if name not in results]


def missing(names: Sequence[str]) -> list[str]:
    """Return a blank line and a line with the command for missing figures, or nothing if none is missing."""
    if not names:
        return []
    if all(PARTS[name].core for name in names):
        return ["", f"Not measured yet: {', '.join(names)} (`make benchmarks`)."]
    return ["", f"Not measured yet: `python -m tests.benchmarks --only {' '.join(names)}`."]


def titled(titles: Sequence[str], rows: Sequence[Sequence[str]], lacking: Sequence[str]) -> list[str]:
    """Return a table, if it has rows, and the line about missing parts."""
    lines = [*(table(titles, rows) if rows else []), *missing(lacking)]
    return lines if rows else lines[1:]


def command(results: Results, name: str, starts: str) -> str:
    """Return the first command of a part that begins with `starts`, without the option `--json`."""
    words = shlex.split(next(line for line in results[name]["commands"] if line.startswith(starts)))
    if "--json" in words:
        at = words.index("--json")
        del words[at : at + 2]
    return f"`{shlex.join(words)}`"
