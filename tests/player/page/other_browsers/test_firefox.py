"""Tests of the page in a second browser, with another shader compiler, against the numpy player."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from player.page.page import page
from player.render import Renderer
from tests.player.page import scenes
from tests.player.page.other_browsers.firefox import firefox_page
from tests.player.page.test_renderer import FAR_OFF, LEVELS


@pytest.mark.parametrize("contracted", [False, True])
def test_firefox_draws_the_players_pictures(contracted: bool, tmp_path: Path) -> None:
    asset = scenes.pyramid_asset(tmp_path / "asset", (1, 2), contracted, 9, sparse=True)
    (tmp_path / "scene.html").write_bytes(page(asset))
    with firefox_page(tmp_path / "scene.html", tmp_path / "profile") as opened:
        assert opened.evaluate("vfr.ready.then(() => vfr.info.contracted)") == contracted
        player = Renderer(asset, 1, "numpy")
        for name in ("outside", "inside"):
            camera = scenes.cameras(asset)[name]
            found = opened.picture(camera, quality="exact")[..., :3].astype(float)
            wanted = player.render(camera).to_uint8()[..., :3]
            assert np.ptp(wanted.reshape(-1, 3), axis=0).max() > 20, "there is something to see"
            off = np.abs(found - wanted)
            LEVELS.check(np.sqrt(np.mean(off**2)))
            FAR_OFF.check((off.max(axis=-1) > 3).mean())
        player.close()
        (tmp_path / "shot.png").write_bytes(opened.screenshot())
        shot = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB"))
        assert np.ptp(shot.reshape(-1, 3), axis=0).max() > 100
        assert opened.said == [] and opened.asked == []
