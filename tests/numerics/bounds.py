"""Rows of docs/numerics.md, each declared beside the test that checks it, and the worst errors that tests
have met.

`pytest --numerics FILE` writes what the tests of a run have met, and `python -m tests.numerics.document` adds
the commit and the processor, and makes the tables of the page.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Met = dict[str, dict[str, dict[str, dict[str, Any]]]]
"""Errors by section, quantity and test (such as `tests/numerics/test_rays.py::test_name`): the worst one in
the unit of the bound, None if the promise is not about a number, and its case: the test's parameters. In the
file, each also has the commit and the processor."""
MET: Met = {}
"""Errors that the tests of this process have met."""


@dataclass(frozen=True)
class Row:
    """The promise for a quantity: one row of a table."""

    section: str
    quantity: str
    range: str = ""
    bound: float | None = None
    """Largest error that is allowed, 0 for exact; None if the promise is not about a number."""
    unit: str = ""
    """Unit of the bound; without a bound, what is promised: "the same bytes", "refused"."""
    at_ends: str = ""
    """What happens at the ends of the range."""

    def check(self, found: Any, wanted: Any = 0.0, of: Any = 1.0) -> None:
        """Assert that `found` is within the bound, and keep the largest error.

        Args:
            found: [any shape] numbers; or errors, if `wanted` is not given.
            wanted: the right numbers, of the same shape. Equal infinities have no error; NaN is never right.
            of: the unit of the bound, of a shape that broadcasts, not negative.
        """
        assert self.bound is not None, "a row without a bound holds, or does not"
        found, wanted, of = (np.asarray(array, np.float64) for array in (found, wanted, of))
        assert wanted.shape in ((), found.shape), f"{self.quantity}: {found.shape} against {wanted.shape}"
        with np.errstate(all="ignore"):
            error = np.where(found == wanted, 0.0, np.abs(found - wanted))
            share = np.where(error == 0, 0.0, error / of)
        wrong = np.argwhere(~(share <= self.bound))
        worst = float(share.max(initial=0.0))
        assert not len(wrong), (
            f"{self.quantity}: expected at most {self.bound:g} {self.unit}, got {worst:.4g};"
            f" {len(wrong)} of {share.size}, the first at {wrong[0].tolist()}"
        )
        self._keep(worst)

    def holds(self, condition: Any = True) -> None:
        """Assert that the condition is true, in every element if it is an array."""
        assert np.all(np.asarray(condition)), f"{self.quantity}: expected {self.unit}"
        self._keep(None)

    def _keep(self, worst: float | None) -> None:
        node = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" (")[0]
        test, _, case = node.partition("[")
        tests = MET.setdefault(self.section, {}).setdefault(self.quantity, {})
        before = tests.get(test, {}).get("worst")
        if test not in tests or (worst is not None and (before is None or worst > before)):
            tests[test] = {"worst": worst, "case": case.removesuffix("]")}


def merged(met: Met, more: Met) -> Met:
    """Return what either has met; for a test that is in both, `more` counts.

    >>> merged({"Rays": {"entry": {"a": {}, "b": {}}}}, {"Rays": {"entry": {"b": {"worst": 1}}}})
    {'Rays': {'entry': {'a': {}, 'b': {'worst': 1}}}}
    """
    both = {
        section: {quantity: dict(tests) for quantity, tests in rows.items()} for section, rows in met.items()
    }
    for section, rows in more.items():
        for quantity, tests in rows.items():
            both.setdefault(section, {}).setdefault(quantity, {}).update(tests)
    return both


def write(path: Path, met: Met) -> None:
    """Write what was met to the file, in which the entries of other tests stay."""
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    text = json.dumps(merged(before, met), indent=1, sort_keys=True, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
