"""docs/numerics.md promises what the tests declare and no more, and shows the worst errors they have met."""

from __future__ import annotations

import importlib
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests import conftest
from tests.numerics import bounds
from tests.numerics.bounds import Row
from tests.numerics.document import (
    BLOCK,
    PAGE,
    REPOSITORY,
    RUNS,
    declared,
    entries,
    read_worst,
    rendered,
    stamp,
)

ROWS = [row for found in declared().values() for _, row in found]


def test_the_page_is_what_rows_and_worst_cases_give() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert rendered(text, ROWS, read_worst()) == text, "run: make numerics"
    tables = {found[2]: found[0] for found in BLOCK.finditer(text)}
    assert sorted([RUNS, *{row.section for row in ROWS}]) == sorted(tables)
    del tables[RUNS]
    lines = [line for table in tables.values() for line in table.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in lines} == {7}


def test_every_row_was_met_within_its_bound_and_there_is_no_other() -> None:
    met = read_worst()
    found = [(section, quantity) for section, rows in met.items() for quantity in rows]
    assert sorted(found) == sorted((row.section, row.quantity) for row in ROWS), "run: make numerics"
    for row in ROWS:
        worst = [entry["worst"] for entry in met[row.section][row.quantity].values()]
        numbers = [number for number in worst if number is not None]
        assert bool(numbers) == (row.bound is not None) and all(n <= (row.bound or 0) for n in numbers), row


def test_every_row_is_checked_where_it_is_declared_by_tests_that_exist() -> None:
    met = read_worst()
    for name, rows in declared().items():
        module = importlib.import_module(name)
        source = Path(str(module.__file__)).read_text(encoding="utf-8")
        path = name.replace(".", "/") + ".py"
        for constant, row in rows:
            assert len(re.findall(rf"\b{constant}\b", source)) > 1, f"{path}: {constant}"
            for test in met[row.section][row.quantity]:
                file, _, function = test.partition("::")
                assert file == path and callable(getattr(module, function)), test


def test_every_case_is_one_that_its_test_still_has() -> None:
    """A test whose parameters changed would otherwise stand on the page with an error of before."""
    met = [test + (f"[{entry['case']}]" if entry["case"] else "") for test, entry in entries(read_worst())]
    files = sorted({test.partition("::")[0] for test in met})
    command = [sys.executable, "-m", "pytest", "-q", "--collect-only", *files]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert sorted(set(met) - set(done.stdout.splitlines())) == [], "run: make numerics"


def test_a_new_error_is_noted_with_its_commit_and_processor() -> None:
    old = {"worst": 1.0, "case": "", "commit": "0a", "processor": "one"}
    met = bounds.merged({"A": {"a": {"x": old, "y": old}}}, {"A": {"a": {"y": {"worst": 2.0, "case": ""}}}})
    stamp(met, "0b", "another")
    assert met["A"]["a"] == {
        "x": old,
        "y": {"worst": 2.0, "case": "", "commit": "0b", "processor": "another"},
    }


# What a row does ----------------------------------------------------------------------------------


@pytest.fixture
def row(monkeypatch: pytest.MonkeyPatch) -> Row:
    monkeypatch.setattr(bounds, "MET", {})
    return Row("Section", "quantity", bound=2.0, unit="u")


@pytest.mark.parametrize("case", ["one"])
def test_the_worst_case_is_kept(row: Row, case: str) -> None:
    row.check([1.0, 2.0], [1.0, 2.5], of=0.5)
    row.check(-1.5)
    row.check(np.zeros((0, 3)), np.zeros((0, 3)))
    row.holds([True, True])
    test = "tests/numerics/test_document.py::test_the_worst_case_is_kept"
    assert bounds.MET == {"Section": {"quantity": {test: {"worst": 1.5, "case": case}}}}


@pytest.mark.parametrize(
    ("found", "wanted", "of"),
    [
        (2.1, 0.0, 1.0),
        (math.nan, 0.0, 1.0),
        (math.nan, math.nan, 1.0),
        (0.0, math.inf, math.inf),
        (math.inf, -math.inf, 1.0),
        (math.inf, 0.0, math.inf),
        (1.0, 0.0, 0.0),
        (1.0, 0.0, math.nan),
        ([0.0, 3.0], [0.0, 0.0], 1.0),
        ([0.0], [0.0, 0.0], 1.0),
    ],
)
def test_what_is_beyond_the_bound_fails(row: Row, found: object, wanted: object, of: float) -> None:
    with pytest.raises(AssertionError, match="quantity: "):
        row.check(found, wanted, of)
    assert bounds.MET == {}


@pytest.mark.parametrize("number", [0.0, 1e300, math.inf, -math.inf])
def test_equal_numbers_have_no_error(row: Row, number: float) -> None:
    row.check(number, number, of=0.0)


def test_what_does_not_hold_fails(row: Row) -> None:
    for wrong in (False, [True, False]):
        with pytest.raises(AssertionError, match="quantity: expected u"):
            row.holds(wrong)


def test_a_worker_hands_over_what_it_has_met(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bounds, "MET", {"A": {"a": {"x": {"worst": 1.0, "case": ""}}}})
    conftest.pytest_testnodedown(SimpleNamespace(workeroutput={"numerics": {"A": {"b": {"y": {}}}}}))
    conftest.pytest_testnodedown(SimpleNamespace())
    assert sorted(bounds.MET["A"]) == ["a", "b"]
    path = tmp_path / "worst.json"
    bounds.write(path, {"A": {"a": {"old": {}}}})
    bounds.write(path, bounds.MET)
    assert sorted(json.loads(path.read_text(encoding="utf-8"))["A"]["a"]) == ["old", "x"]


@pytest.mark.parametrize("workers", [[], ["-n", "2"]], ids=["alone", "workers"])
def test_a_run_writes_what_it_has_met(workers: list[str], tmp_path: Path) -> None:
    path = tmp_path / "worst.json"
    test = "tests/numerics/test_quantisation_and_pictures.py::test_8_bit_rounding_at_every_joint"
    command = [sys.executable, "-m", "pytest", "-q", "--numerics", str(path), *workers, test]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert json.loads(path.read_text(encoding="utf-8"))["Pictures"]["8-bit values"] == {
        test: {"worst": 0, "case": ""}
    }
