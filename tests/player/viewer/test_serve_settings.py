"""Tests of the settings that a program serves the viewer with."""

from __future__ import annotations

import numpy as np
import pytest

from player.errors import ConfigError
from player.viewer.server import ServeSettings, serve


def test_settings_of_the_viewer_are_checked_when_they_are_made() -> None:
    settings = ServeSettings(samples=np.int64(3), background=np.ones(3))  # type: ignore[arg-type]
    assert settings == ServeSettings(samples=3, background=(1.0, 1.0, 1.0))
    for wrong, message in (
        ({"port": 70000}, "port: expected 1 to 65535, got 70000"),
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
