"""Fixture of the viewer's tests: they may use every core."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.cores import every_core


@pytest.fixture(scope="module", autouse=True)
def cores() -> Iterator[None]:
    """Let these tests use every core: a browser and its test mostly wait for each other."""
    with every_core():
        yield
