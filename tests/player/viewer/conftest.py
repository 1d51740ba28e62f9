"""What the tests of the viewer share: they do not keep to a share of the cores."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.cores import every_core


@pytest.fixture(scope="module", autouse=True)
def cores() -> Iterator[None]:
    """A browser waits for what looks at it, which waits for the browser: together they use every core."""
    with every_core():
        yield
