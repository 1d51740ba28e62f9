"""Tests of settings and cameras that a program hands to `play` and that cannot be rendered."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from player.app.options import PlaySettings, parse
from player.app.play import play
from player.asset.asset import Asset
from player.cameras.views import asset_cameras
from player.errors import ConfigError


@pytest.mark.parametrize(
    ("output", "settings", "message"),
    [
        ("a", {"resume": True, "force": True}, "--resume: not allowed with --force"),
        ("a.png", {"format": "webp"}, "--format: a.png says which format it is"),
        ("a.MP4", {"background": "transparent"}, "--background: a video has no transparency"),
        ("a", {"samples": 2.5}, "samples: expected 0 .all. or more, a whole number, got 2.5"),
        ("a", {"quality": "best"}, "quality: expected exact, high or fast, got best"),
        ("a", {"format": "jpg"}, "format: expected png or webp, got jpg"),
        ("a", {"background": np.ones(2)}, "background: expected three numbers in 0"),
        ("a", {"background": "white"}, "background: expected three numbers in 0"),
        ("a", {"march": "cuda"}, "march: expected auto, numpy or numba, got cuda"),
        ("a", {"threads": 0}, "threads: expected at least 1, got 0"),
        ("a", {"resume": "yes"}, "resume: expected True or False, got yes"),
        ("a", {"force": 1}, "force: expected True or False, got 1"),
        *(
            ("a", {"frames": frames}, "frames: expected a slice of whole numbers, such as slice")
            for frames in (1, "1:3", slice(0.5), slice(0, 4, 0))
        ),
        *(
            ("a", {"max_memory": gigabytes}, "max_memory: expected gigabytes, more than 0, got ")
            for gigabytes in (-1, 0, math.nan, math.inf, "4")
        ),
        *(
            ("a.mp4", {"fps": fps}, "--fps: expected 0.001 to 1000 frames a second, got ")
            for fps in (0, 0.0009, 1001, -30, math.nan, math.inf, None, "fast")
        ),
    ],
)
def test_settings_that_cannot_be(output: str, settings: dict[str, Any], message: str) -> None:
    for named in (Path(output), output):
        with pytest.raises(ConfigError, match=message):
            PlaySettings(named, **settings)


def test_settings_of_any_number_type_are_taken() -> None:
    numbers: dict[str, Any] = {"threads": np.int64(2), "max_memory": np.float32(0.5)}
    settings = PlaySettings("turn", frames=slice(None, None, -2), **numbers)
    assert (settings.threads, settings.max_memory) == (2, 0.5)


def test_cameras_that_are_no_list_of_some_are_refused_by_name(asset: Asset, tmp_path: Path) -> None:
    settings = PlaySettings(tmp_path / "turn", march="numpy")
    camera = asset_cameras(asset)[0]
    with pytest.raises(ConfigError, match=r"^cameras: expected a list of cameras, got one: write"):
        play(asset, camera, settings)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"^cameras: expected at least one, got none$"):
        play(asset, [], settings)
    assert not list(tmp_path.iterdir())
    assert play(asset, [camera], settings).figures["frames"] == 1


def test_assets_may_stand_between_options() -> None:
    read = parse(["fidelity/", "--port", "9000", "fast/", "--samples", "4"])
    assert (read.asset, read.others) == (Path("fidelity"), [Path("fast")])
    assert (read.port, read.samples) == (9000, 4)
