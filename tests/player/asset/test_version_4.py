"""Tests of the promise of docs/format.md: a baked asset of version 4.0 that was kept plays as it did then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from player.asset.asset import Asset
from player.asset.manifest import VERSION
from player.cameras.views import asset_cameras
from player.render import Renderer

HERE = Path(__file__).parent
KEPT = HERE / "version_4_0"


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_it_plays_as_it_did(parts: int) -> None:
    """The kept pictures are those of the first part, of the first two and of all, rendered by numpy."""
    Asset.open(KEPT / "asset", verify=True)
    asset = Asset.open(KEPT / "asset", parts=parts)
    assert asset.manifest.version == (4, 0) and asset.manifest.n_fetches == 12
    assert (asset.n_parts, asset.missing) == (parts, None)
    camera = asset_cameras(asset)[0].resized(24, 24)
    with np.load(KEPT / "played.npz") as played, Renderer(asset, 1, "numpy") as renderer:
        frame = renderer.render(camera)
        assert np.array_equal(frame.n_density_samples, played[f"n_density_samples_{parts}"])
        assert frame.opacity.max() > 0.9 and np.ptp(frame.rgb) > 0.5
        for name in ("opacity", "depth"):
            assert np.abs(getattr(frame, name) - played[f"{name}_{parts}"]).max() < 1e-5, name
        # The head rounds to 8 bits: where another processor's float32 differs in its last bit, a number
        # within the head may be rounded to the other side.
        rgb = np.abs(frame.rgb - played[f"rgb_{parts}"])
        assert rgb.max() < 1 / 255 and rgb.mean() < 1e-5


def test_it_has_what_a_bake_writes() -> None:
    """The kept asset has levels that are marched in longer steps, values in steps, and a head in 8 bits."""
    asset = Asset.open(KEPT / "asset")
    manifest = asset.manifest
    assert manifest.level_steps == (1, 2, 4, 4) and manifest.density_steps == (4, 4, 4, 4)
    assert (len(manifest.feature_steps), manifest.n_channels, len(manifest.parts)) == (3, 5, 3)
    assert b"QuantizeLinear" in asset.read("head.onnx")


def test_an_asset_of_the_version_that_is_written_is_kept() -> None:
    assert (HERE / f"version_{VERSION[0]}_{VERSION[1]}" / "asset" / "manifest.json").is_file()
