"""A browser for the tests of the page."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.cores import every_core
from tests.player.page import viewer_page


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """Chromium with WebGL on the processor; one at a time, as Playwright wants it."""
    with viewer_page.chromium() as browser:
        yield browser


@pytest.fixture(scope="module", autouse=True)
def cores() -> Iterator[None]:
    """A browser waits for what looks at it, which waits for the browser: together they use every core."""
    with every_core():
        yield
