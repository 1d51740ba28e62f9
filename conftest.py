"""What the tests and the examples in docstrings share: guarded arrays, and a small asset, to be opened as
"out/" in the latter."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

# Before player is imported, here and in every process that a test starts: compiled code that writes beside
# its arrays is found out (`player.scratch`).
os.environ["VFR_CANARIES"] = "1"


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
