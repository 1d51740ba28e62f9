"""A browser for the tests of the page."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.cores import every_core
from tests.player.page import viewer_page


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """Start Chromium with WebGL on the processor; one at a time, as Playwright requires."""
    with viewer_page.chromium() as browser:
        yield browser


@pytest.fixture(scope="module", autouse=True)
def cores() -> Iterator[None]:
    """Let these tests use every core: a browser and its test mostly wait for each other."""
    with every_core():
        yield
