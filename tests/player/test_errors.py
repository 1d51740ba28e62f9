"""The classes of errors are those that the manual promises to programs."""

from __future__ import annotations

import re
from pathlib import Path

from player import errors

PAGE = Path(__file__).parents[2] / "docs" / "python.md"


def test_the_table_of_errors_is_the_classes() -> None:
    rows = re.findall(r"^\| `(\w+Error)` \|(.*?)\|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    classes = {name for name, kind in vars(errors).items() if isinstance(kind, type)}
    assert {name for name, _ in rows} == classes - {"VfrError"}
    for name, also in rows:
        bases = [base.__name__ for base in getattr(errors, name).__bases__ if base.__name__ != "VfrError"]
        assert bases == re.findall(r"`(\w+)`", also), name
