"""What a renderer of the page does beside pictures: depths, sums, a lost context, another scene, errors."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser

from player.asset.asset import Asset
from player.march.march import sample_rays
from tests.numerics.bounds import Row
from tests.player.page import scenes
from tests.player.page.render_page import RenderPage, view_of

REUSE = "Reuse between frames"
MEAN = Row(
    REUSE, "canvas of a camera that stands still, against the mean of the pictures",
    "8 pictures, each moved by a part of a pixel, added up in float16", 2, "levels of 8 bits",
    "the most that the viewer adds up",
)  # fmt: skip
ANEW = Row(REUSE, "sum after a picture that is not added up", unit="begins anew: the same bytes as before")
CANVAS = """([view, jitters]) => {
  const { gl, canvas } = renderer;
  renderer.resize(view.width, view.height);
  renderer.draw(view);
  for (const jitter of jitters) renderer.draw({ ...view, jitter, accumulate: true });
  const bytes = new Uint8Array(4 * view.width * view.height);
  gl.readPixels(0, 0, view.width, view.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  return btoa(String.fromCharCode(...bytes));
}"""


@pytest.fixture(scope="module")
def page(chromium: Browser, asset: Asset, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RenderPage]:
    found = RenderPage(chromium, asset, tmp_path_factory.mktemp("calls") / "scene.html")
    yield found
    found.close()
    assert found.asked == []


def canvas(page: RenderPage, view: dict[str, Any], jitters: list[tuple[float, float]]) -> np.ndarray:
    """What the canvas shows after a picture and some that are added up, [h, w, 4], premultiplied."""
    found = np.frombuffer(base64.b64decode(page.page.evaluate(CANVAS, [view, jitters])), np.uint8)
    return found.reshape(view["height"], view["width"], 4)[::-1]


def test_depths_are_where_half_the_opacity_is(page: RenderPage, asset: Asset) -> None:
    camera = scenes.cameras(asset)["outside"]
    model = camera.transformed(np.linalg.inv(asset.world_from_model))
    rays_o, rays_d = (rays.astype(np.float32) for rays in model.rays())
    path, samples, *_ = sample_rays(asset.grid, np.broadcast_to(rays_o, rays_d.shape), rays_d)
    seen = 0
    for x, y in ((30, 22), (12, 9), (41, 30), (22, 35), (0, 0)):
        own = samples.ray == y * camera.width + x
        found = page.page.evaluate(
            "([view, x, y]) => renderer.depthAt(view, x, y)", [view_of(camera), x + 0.7, y]
        )
        if not own.any():
            assert found is None
            continue
        seen += 1
        mass = np.cumsum(samples.weights[own])
        s = samples.s[own][np.searchsorted(mass, mass[-1] / 2)]
        ray = np.array([y * camera.width + x])
        step = float(asset.grid.step) * asset.scale
        assert found == pytest.approx(float(path.distances(ray, s[None])[0]) * asset.scale, abs=1.01 * step)
    assert seen >= 3


def test_the_canvas_shows_the_picture_upright_and_premultiplied(page: RenderPage, asset: Asset) -> None:
    camera = scenes.cameras(asset)["outside"]
    for background in ("transparent", [0.1, 0.9, 0.4]):
        settings = {"quality": "exact", "background": background}
        wanted = page.picture(camera, **settings).astype(float)
        wanted[..., :3] *= wanted[..., 3:] / 255
        shown = canvas(page, view_of(camera) | settings, [])
        assert np.abs(shown - wanted).max() <= 1.6, "three roundings"


def test_pictures_add_up_to_their_mean(page: RenderPage, asset: Asset) -> None:
    """Each moved by a part of a pixel: as a camera whose principal point is elsewhere."""
    camera = scenes.cameras(asset)["outside"]
    settings = {"quality": "exact", "background": [0.1, 0.9, 0.4]}
    jitters = [
        (0.0, 0.0),
        (0.4, -0.3),
        (-0.25, 0.45),
        (0.1, 0.2),
        (0.3, 0.3),
        (-0.4, -0.1),
        (-0.1, 0.4),
        (0.2, -0.4),
    ]
    moved = [replace(camera, cx=camera.cx - dx, cy=camera.cy - dy) for dx, dy in jitters]
    wanted = np.mean([page.picture(some, **settings).astype(float) for some in moved], axis=0)
    shown = canvas(page, view_of(camera) | settings, jitters)
    MEAN.check(shown, wanted)
    assert np.abs(wanted - page.picture(camera, **settings)).max() > 8, "the pictures differ"
    again = canvas(page, view_of(camera) | settings, jitters)
    ANEW.holds(again == shown)


def test_a_lost_context_comes_back(page: RenderPage, asset: Asset) -> None:
    camera = scenes.cameras(asset)["inside"]
    before = page.picture(camera, quality="exact")
    page.page.evaluate(
        """async () => {
          const lose = renderer.gl.getExtension("WEBGL_lose_context");
          const lost = new Promise((resolve) => { renderer.onlost = resolve; });
          lose.loseContext();
          await lost;
          renderer.draw({ c2w: new Array(16).fill(0), fx: 1, fy: 1, cx: 1, cy: 1, width: 2, height: 2 });
          globalThis.refused = await renderer.render({}).catch((error) => error.message);
          await new Promise((resolve) => { setTimeout(resolve, 50); }); // not while it is told
          const restored = new Promise((resolve) => { renderer.onrestored = resolve; });
          lose.restoreContext();
          await restored;
        }"""
    )
    assert "expected a context, got one that was lost" in page.page.evaluate("() => refused")
    assert (page.picture(camera, quality="exact") == before).all()


def test_another_scene_takes_its_place(page: RenderPage, asset: Asset) -> None:
    """The same with fewer features: negated, and back again."""
    camera = scenes.cameras(asset)["outside"]
    before = page.picture(camera)
    page.page.evaluate(
        """() => {
          const { scene } = renderer;
          globalThis.first = scene;
          const features = scene.grid.features.map((x) => -x);
          renderer.replace({ ...scene, grid: { ...scene.grid, features } });
        }"""
    )
    other = page.picture(camera)
    assert (np.abs(other.astype(int) - before).max(axis=-1) > 10).mean() > 0.1
    page.page.evaluate("() => renderer.replace(first)")
    assert (page.picture(camera) == before).all()


def test_coarser_qualities_fetch_less_and_look_alike(page: RenderPage, asset: Asset) -> None:
    camera = scenes.cameras(asset)["outside"]
    costs, pictures = [], []
    for quality in ("exact", "high", "fast"):
        found = page.page.evaluate("view => counts(view)", view_of(camera) | {"quality": quality})
        costs.append(int(page.array(found["fetches"], np.uint32).sum()))
        pictures.append(page.picture(camera, quality=quality).astype(float))
    assert costs[0] >= costs[1] > costs[2]
    errors = [np.mean((some - pictures[0]) ** 2) for some in pictures[1:]]
    assert errors[0] <= errors[1] < 50


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"c2w": [1, 2]}, "c2w: expected 16 numbers, got [1,2]"),
        ({"fx": 0}, "fx: expected a number above 0, got 0"),
        ({"width": 2.5}, "width: expected a whole number above 0, got 2.5"),
        ({"quality": "best"}, 'quality: expected exact, high, fast, got "best"'),
        ({"background": "red"}, 'background: expected [r, g, b] or "transparent", got "red"'),
        ({"width": 1 << 20}, "size: expected at most"),
    ],
)
def test_views_that_are_none_are_told(
    page: RenderPage, asset: Asset, change: dict[str, Any], message: str
) -> None:
    view = view_of(scenes.cameras(asset)["outside"]) | change
    told = page.page.evaluate("view => vfr.render(view).catch((error) => error.message)", view)
    assert message in told
