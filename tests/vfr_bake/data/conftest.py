"""What all tests of reading data share."""

from __future__ import annotations

from pathlib import Path

import pytest

from vfr_bake.data import poses


@pytest.fixture(autouse=True)
def kept(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a test's matches are kept: not in the user's own cache."""
    root = tmp_path_factory.mktemp("kept")
    monkeypatch.setattr(poses, "cache_root", lambda: root)
    return root
