"""Tests of the figures that playing reports."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from player.app.options import PlaySettings
from player.app.play import play
from player.asset.asset import Asset
from player.asset.grid import SparseGrid
from player.cameras.transforms import read_cameras
from player.march.interpolation import Quality
from player.march.march import MarchResult, march


@pytest.mark.parametrize(
    ("samples", "quality", "used"),
    [
        (None, "exact", 5),
        (None, "high", 4),
        (None, "fast", 3),
        (4, "fast", 3),
        (2, "fast", 2),
        (0, "fast", 3),
        (1_000_000, "exact", 126),
    ],
)
def test_the_fetches_that_the_march_was_given_are_reported(
    samples: int | None,
    quality: Quality,
    used: int,
    asset: Asset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An asset may lower the number for a quality, and no ray has more samples than fit along the diagonal of
    the box."""
    asset = replace(asset, manifest=replace(asset.manifest, quality_fetches=(4, 3)))
    given: set[int] = set()

    def noted(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, k: int, *rest: Any) -> MarchResult:
        given.add(k)
        return march(grid, rays_o, rays_d, k, *rest)

    monkeypatch.setattr("player.march.march.march", noted)
    camera = read_cameras(asset.path("cameras.json"))[0]
    settings = PlaySettings(tmp_path / "view.png", samples=samples, quality=quality, march="numpy")
    assert play(asset, [camera], settings).figures["n_fetches"] == used
    assert given == {used}
