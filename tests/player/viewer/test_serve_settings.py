"""Tests of the settings that a program serves the viewer with."""

from __future__ import annotations

import numpy as np
import pytest

from player.errors import ConfigError
from player.viewer.server import ServeSettings, _shown, serve


def test_settings_of_the_viewer_are_checked_when_they_are_made() -> None:
    settings = ServeSettings(samples=np.int64(3), background=np.ones(3))  # type: ignore[arg-type]
    assert settings == ServeSettings(samples=3, background=(1.0, 1.0, 1.0))
    for wrong, message in (
        ({"port": 70000}, "port: expected 1 to 65535, got 70000"),
        ({"port": "8080"}, "port: expected 1 to 65535, got '8080'"),
        ({"samples": -1}, "samples: expected 0"),
        ({"quality": "best"}, "quality: expected exact, high or fast, got best"),
        ({"background": "white"}, "background: expected three numbers in 0"),
        ({"background": "transparent"}, "expected a colour for the viewer, got transparent"),
        ({"march": "cuda"}, "march: expected auto, numpy or numba, got cuda"),
        ({"threads": 0}, "threads: expected at least 1, got 0"),
        ({"max_memory": -1}, "max_memory: expected gigabytes, more than 0, got -1"),
    ):
        with pytest.raises(ConfigError, match=message):
            ServeSettings(**wrong)
    with pytest.raises(ConfigError, match="assets: expected at least one, got none"), serve([]):
        pass


@pytest.mark.parametrize(
    ("host", "address"), [("0.0.0.0", "127.0.0.1"), ("::", "[::1]"), ("::1", "[::1]"), ("studio", "studio")]
)
def test_the_printed_address_is_one_that_answers(host: str, address: str) -> None:
    """A server at `::` answers IPv6 alone, so that 127.0.0.1 would be refused."""
    assert _shown(host) == address
