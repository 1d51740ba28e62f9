"""What all tests share: where the real pictures are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# A deadline measures the machine, not the code.
settings.register_profile("any_machine", deadline=None)
settings.load_profile("any_machine")

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def lego_400() -> Path:
    """The NeRF-synthetic lego 400x400, in `$VFR_DATA` (default `../shared/data`); missing, the test fails."""
    data = os.environ.get("VFR_DATA")
    root = Path(data) if data else REPOSITORY.parent / "shared" / "data"
    folder = root / "lego_400"
    if not (folder / "transforms_train.json").is_file():
        pytest.fail(f"{folder}: expected the lego_400 data set: set VFR_DATA to the folder that holds it")
    return folder
