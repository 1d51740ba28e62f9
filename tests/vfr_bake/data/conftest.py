"""Fixture that all tests of reading data share."""

from __future__ import annotations

from pathlib import Path

import pytest

from vfr_bake.data import poses


@pytest.fixture(autouse=True)
def kept(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder for the test's features and matches, in place of the user's own cache."""
    root = tmp_path_factory.mktemp("kept")
    monkeypatch.setattr(poses, "cache_root", lambda: root)
    return root
