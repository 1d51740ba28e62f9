"""Tests of the page's renderer beside pictures: depths, sums, a lost context, another scene, errors."""

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

LOST_AND_BACK = """
const pause = (ms) => new Promise((go) => { setTimeout(go, ms); });
const heard = (canvas, name) => new Promise((go) => canvas.addEventListener(name, go, { once: true }));
const lostAndBack = async (canvas, meanwhile) => {
  const lose = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
  const lost = heard(canvas, "webglcontextlost");
  lose.loseContext();
  await meanwhile(lost);
  await lost;
  await pause(50); // not while it is told
  const restored = heard(canvas, "webglcontextrestored");
  lose.restoreContext();
  await restored;
};
"""
"""JavaScript of `lostAndBack(canvas, meanwhile)`: loses the context, and restores it after `meanwhile`."""
NEGATED = """
const { scene } = renderer;
const negated = { ...scene, grid: { ...scene.grid, features: scene.grid.features.map((x) => -x) } };
"""
"""JavaScript of `negated`: the scene with negated features, so that its colours differ."""


NOT_RIGID = "c2w: expected a rotation and a translation, row by row, got ["


@pytest.fixture(scope="module")
def page(chromium: Browser, asset: Asset, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RenderPage]:
    found = RenderPage(chromium, asset, tmp_path_factory.mktemp("calls") / "scene.html")
    yield found
    found.close()
    assert found.asked == []


def canvas(page: RenderPage, view: dict[str, Any], jitters: list[tuple[float, float]]) -> np.ndarray:
    """Return what the canvas shows after a picture and some accumulated ones: [h, w, 4], premultiplied."""
    found = np.frombuffer(base64.b64decode(page.page.evaluate(CANVAS, [view, jitters])), np.uint8)
    return found.reshape(view["height"], view["width"], 4)[::-1]


def test_a_picture_without_a_quality_is_exact(page: RenderPage, asset: Asset) -> None:
    camera = scenes.cameras(asset)["outside"]
    page.page.evaluate("() => { renderer.scene.manifest.quality_fetches = [1, 1]; }")
    try:
        plain, exact, high = (
            page.picture(camera, **more) for more in ({}, {"quality": "exact"}, {"quality": "high"})
        )
    finally:
        page.page.evaluate("() => { delete renderer.scene.manifest.quality_fetches; }")
    assert (plain == exact).all() and not (exact == high).all()


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
    """Accumulated pictures, each moved by a part of a pixel (by its principal point), show their mean."""
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


def test_where_no_sums_can_be_drawn_the_last_picture_is_shown_unmoved(page: RenderPage, asset: Asset) -> None:
    view = view_of(scenes.cameras(asset)["outside"]) | {"quality": "exact", "width": 62}
    unmoved = canvas(page, view, [])
    page.page.evaluate(
        """() => {
          const { gl, sums } = renderer;
          globalThis.sumsAgain = () => {
            delete gl.checkFramebufferStatus;
            renderer.sums = sums;
          };
          gl.checkFramebufferStatus = () => gl.FRAMEBUFFER_UNSUPPORTED;
        }"""
    )
    shown = canvas(page, view, [(0.4, -0.3), (-0.25, 0.45)])
    page.page.evaluate("() => sumsAgain()")
    assert (shown == unmoved).all()
    assert (canvas(page, view, [(0.4, -0.3)]) != unmoved).any(), "sums are drawn again, of moved pictures"


@pytest.mark.parametrize("layer", ["depth", "normals", "opacity"])
def test_layers_that_are_not_added_up_are_shown_unmoved(page: RenderPage, asset: Asset, layer: str) -> None:
    view = view_of(scenes.cameras(asset)["outside"]) | {"quality": "exact", "layer": layer}
    unmoved = canvas(page, view, [])
    assert np.ptp(unmoved) > 100, "there is something to see"
    assert (canvas(page, view, [(0.4, -0.3), (-0.25, 0.45)]) == unmoved).all()


@pytest.mark.parametrize("n", [0, 1], ids=["found", "colours"])
def test_a_graphics_card_that_cannot_draw_the_channels_is_told(page: RenderPage, n: int) -> None:
    """The first framebuffer that a renderer makes holds what the march finds, the second the colours."""
    told = page.page.evaluate(
        """async (n) => {
          const canvas = document.createElement("canvas"), gl = canvas.getContext("webgl2");
          const { FRAMEBUFFER_COMPLETE, FRAMEBUFFER_UNSUPPORTED } = gl;
          let asked = 0;
          gl.checkFramebufferStatus = () => (asked++ === n ? FRAMEBUFFER_UNSUPPORTED : FRAMEBUFFER_COMPLETE);
          const making = renderer.constructor.create(canvas, { ...renderer.scene, grid: null });
          return making.then(() => "a renderer", (error) => error.message);
        }""",
        n,
    )
    assert told == "WebGL2: expected framebuffers for 4 channels, got an incomplete one"


def test_a_lost_context_comes_back(page: RenderPage, asset: Asset) -> None:
    camera = scenes.cameras(asset)["inside"]
    before = page.picture(camera, quality="exact")
    page.page.evaluate(
        f"""async () => {{
          {LOST_AND_BACK}
          await lostAndBack(renderer.canvas, async (lost) => {{
            await lost;
            renderer.draw({{ c2w: new Array(16).fill(0), fx: 1, fy: 1, cx: 1, cy: 1, width: 2, height: 2 }});
            globalThis.refused = await renderer.render({{}}).catch((error) => error.message);
          }});
        }}"""
    )
    assert "expected a context, got one that was lost" in page.page.evaluate("() => refused")
    assert (page.picture(camera, quality="exact") == before).all()


def test_a_scene_that_comes_while_the_context_is_lost_is_shown_when_it_is_back(
    page: RenderPage, asset: Asset
) -> None:
    camera = scenes.cameras(asset)["outside"]
    before = page.picture(camera)
    page.page.evaluate(
        f"""async () => {{
          {LOST_AND_BACK} {NEGATED}
          globalThis.first = scene;
          await lostAndBack(renderer.canvas, async () => renderer.replace(negated));
        }}"""
    )
    assert differs(page.picture(camera), before)
    page.page.evaluate("() => renderer.replace(first)")
    assert (page.picture(camera) == before).all()


def test_a_renderer_waits_for_a_context_that_is_lost_while_its_shaders_are_compiled(
    page: RenderPage, asset: Asset
) -> None:
    camera = scenes.cameras(asset)["outside"]
    found = page.page.evaluate(
        f"""async (view) => {{
          {LOST_AND_BACK}
          const canvas = document.createElement("canvas"), {{ scene }} = renderer;
          const making = renderer.constructor.create(canvas, {{ ...scene, grid: null }});
          const [made] = await Promise.all([making, lostAndBack(canvas, async () => {{}})]);
          made.replace(scene);
          return [...(await made.render(view)).rgba];
        }}""",
        view_of(camera),
    )
    assert (np.reshape(found, (camera.height, camera.width, 4)) == page.picture(camera)).all()


def test_a_context_that_is_lost_just_before_its_limits_are_asked_for(page: RenderPage, asset: Asset) -> None:
    """A lost context tells no limits. It is lost for a renderer that is being made, which waits for it, and
    then for a picture."""
    camera = scenes.cameras(asset)["outside"]
    told, found = page.page.evaluate(
        f"""async (view) => {{
          {LOST_AND_BACK}
          const canvas = document.createElement("canvas"), gl = canvas.getContext("webgl2");
          const {{ getParameter }} = gl;
          const lostAt = (name) => new Promise((go) => {{
            gl.getParameter = (asked) => {{
              if (asked === gl[name]) go(lostAndBack(canvas, async () => delete gl.getParameter));
              return getParameter.call(gl, asked);
            }};
          }});
          const first = lostAt("MAX_DRAW_BUFFERS");
          const made = await renderer.constructor.create(canvas, renderer.scene);
          await first;
          const second = lostAt("MAX_TEXTURE_SIZE");
          const told = await made.render(view).catch((error) => error.message);
          await second;
          return [told, [...(await made.render(view)).rgba]];
        }}""",
        view_of(camera),
    )
    assert told == "WebGL2: expected a context, got one that was lost"
    assert (np.reshape(found, (camera.height, camera.width, 4)) == page.picture(camera)).all()


def test_nobody_waits_for_what_was_drawn_before_a_context_was_lost_and_came_back(page: RenderPage) -> None:
    told = page.page.evaluate(
        f"""async () => {{
          {LOST_AND_BACK}
          const {{ gl }} = renderer, real = setTimeout, held = [];
          gl.clientWaitSync = () => (delete gl.clientWaitSync, gl.TIMEOUT_EXPIRED);
          globalThis.setTimeout = (go) => held.push(go); // it asks again only when the context is back
          const told = renderer.done().then(() => "done", (error) => error.message);
          globalThis.setTimeout = real;
          await lostAndBack(renderer.canvas, async () => {{}});
          for (const go of held) go();
          return [held.length, await Promise.race([told, pause(3000)])];
        }}"""
    )
    assert told == [1, "WebGL2: expected a context, got one that was lost"]


def differs(one: np.ndarray, two: np.ndarray) -> bool:
    return bool((np.abs(one.astype(int) - two).max(axis=-1) > 10).mean() > 0.1)


def test_another_scene_takes_its_place(page: RenderPage, asset: Asset) -> None:
    """Another scene, with negated features, replaces the shown one, and the first one replaces it again."""
    camera = scenes.cameras(asset)["outside"]
    before = page.picture(camera)
    page.page.evaluate(f"() => {{ {NEGATED} globalThis.first = scene; renderer.replace(negated); }}")
    assert differs(page.picture(camera), before)
    page.page.evaluate("() => renderer.replace(first)")
    assert (page.picture(camera) == before).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("negated.grid.nb = 100000;", "memory of the GPU: expected textures of 100000 texels a side, got at"),
        (
            "gl.getError = () => (delete gl.getError, gl.OUT_OF_MEMORY);",
            "memory of the GPU: expected enough for this scene, got too little",
        ),
    ],
    ids=["size", "memory"],
)
def test_a_scene_that_does_not_fit_leaves_the_one_before(
    page: RenderPage, asset: Asset, change: str, message: str
) -> None:
    camera = scenes.cameras(asset)["outside"]
    before = page.picture(camera)
    told = page.page.evaluate(
        f"""() => {{
          {NEGATED}
          const {{ gl }} = renderer;
          {change}
          try {{
            renderer.replace(negated);
          }} catch (error) {{
            return error.message;
          }}
        }}"""
    )
    assert message in told
    assert (page.picture(camera) == before).all()


@pytest.mark.parametrize(
    "fails",
    [
        "gl.texStorage2D = () => {};",
        "gl.bufferData = () => {}; gl.getError = () => (delete gl.getError, gl.OUT_OF_MEMORY);",
        "let n = 0; gl.getError = () => (n++ ? (delete gl.getError, gl.OUT_OF_MEMORY) : gl.NO_ERROR);",
    ],
    ids=["target", "buffer", "late"],
)
def test_a_picture_for_which_memory_is_short_is_refused(page: RenderPage, asset: Asset, fails: str) -> None:
    camera = scenes.cameras(asset)["outside"]
    before = page.picture(camera)
    told = page.page.evaluate(
        f"""async (view) => {{
          const {{ gl }} = renderer;
          {fails}
          const told = await vfr.render(view).then(() => "a picture", (error) => error.message);
          for (const name of ["texStorage2D", "bufferData", "getError"]) delete gl[name];
          return told;
        }}""",
        view_of(camera) | {"width": 67, "height": 51},
    )
    assert told == "memory of the GPU: expected enough for a picture of 67x51, got too little"
    assert (page.picture(camera) == before).all()


def test_a_view_that_moves_on_changes_no_picture_that_was_asked_for(page: RenderPage, asset: Asset) -> None:
    camera = scenes.cameras(asset)["outside"]
    found = page.page.evaluate(
        """async (view) => {
          const pictures = [];
          for (const red of [0, 1]) {
            view.background[0] = red;
            view.c2w[3] += red;
            pictures.push(vfr.render(view));
          }
          return (await Promise.all(pictures)).map(({ rgba }) => [...rgba]);
        }""",
        view_of(camera) | {"background": [0, 0, 0]},
    )
    wanted = page.picture(camera, background=[0, 0, 0])
    assert (np.reshape(found[0], wanted.shape) == wanted).all() and found[0] != found[1]


def test_pictures_that_are_asked_for_at_once_are_rendered_one_after_another(
    page: RenderPage, asset: Asset
) -> None:
    """An error of one of them changes nothing for the others."""
    camera = scenes.cameras(asset)["outside"]
    wanted = page.picture(camera)
    most, pictures = page.page.evaluate(
        """async (view) => {
          const { gl } = renderer, { createBuffer, deleteBuffer } = gl;
          let n = 0, most = 0;
          gl.createBuffer = () => (most = Math.max(most, ++n), createBuffer.call(gl));
          gl.deleteBuffer = (buffer) => (n--, deleteBuffer.call(gl, buffer));
          const views = [view, { ...view, fx: 0 }, { ...view, width: 1 << 20 }, view, view];
          const found = await Promise.allSettled(views.map((each) => vfr.render(each)));
          for (const name of ["createBuffer", "deleteBuffer"]) delete gl[name];
          return [most, found.map(({ value }) => value && [...value.rgba])];
        }""",
        view_of(camera),
    )
    assert most == 1 and [picture is None for picture in pictures] == [False, True, True, False, False]
    for picture in pictures[::3]:
        assert (np.reshape(picture, wanted.shape) == wanted).all()


def test_a_picture_keeps_no_memory(page: RenderPage, asset: Asset) -> None:
    found = page.page.evaluate(
        """async (view) => {
          const { gl } = renderer, made = [], real = gl.createTexture;
          gl.createTexture = () => made[made.push(real.call(gl)) - 1];
          await vfr.render(view);
          delete gl.createTexture;
          return [made.length, made.filter((texture) => gl.isTexture(texture)).length];
        }""",
        view_of(scenes.cameras(asset)["outside"]) | {"width": 69, "height": 53},
    )
    assert found == [1, 0]


LIMIT = "(limits) => Object.assign(renderer.scene.manifest, { quality_fetches: limits })"
"""JavaScript that sets the limits on the lookups of high and fast pictures."""


def test_coarser_qualities_fetch_less_and_look_alike(page: RenderPage, asset: Asset) -> None:
    camera = scenes.cameras(asset)["outside"]
    costs, pictures = [], []
    page.page.evaluate(LIMIT, [4, 2])
    for quality in ("exact", "high", "fast"):
        found = page.page.evaluate("view => counts(view)", view_of(camera) | {"quality": quality})
        costs.append(int(page.array(found["fetches"], np.uint32).sum()))
        pictures.append(page.picture(camera, quality=quality).astype(float))
    page.page.evaluate(LIMIT, None)
    assert costs[0] >= costs[1] > costs[2]
    errors = [np.mean((some - pictures[0]) ** 2) for some in pictures[1:]]
    assert errors[0] <= errors[1] < 50


QUALITIES = """(changes) => {
  const { scene } = renderer, { manifest } = scene;
  scene.manifest = { ...manifest, ...changes };
  const found = ["exact", "high", "fast"].map((quality) => renderer.quality({ quality }));
  scene.manifest = manifest;
  return found.map(({ uFetches, uLongestStep }) => [uFetches, uLongestStep]);
}"""
"""JavaScript that returns the lookups and the longest step of each quality for a changed manifest."""


@pytest.mark.parametrize(
    ("n_fetches", "limits", "lookups"),
    [
        (12, [8, 4], [12, 8, 4]),
        (12, [0, 8], [12, 12, 8]),
        (12, [0, 0], [12, 12, 12]),
        (12, [16, 13], [12, 12, 12]),
        (0, [8, 0], [0, 8, 0]),
        (12, None, [12, 12, 12]),
    ],
)
def test_qualities_keep_to_the_lookups_that_the_bake_found(
    page: RenderPage, n_fetches: int, limits: list[int] | None, lookups: list[int]
) -> None:
    """The manifest's `quality_fetches` limit the lookups, and 0 is no limit; without them, as in assets of
    earlier versions, there is none either."""
    changes = {"n_fetches": n_fetches} | ({} if limits is None else {"quality_fetches": limits})
    found = page.page.evaluate(QUALITIES, changes)
    assert [lookups for lookups, _ in found] == lookups
    assert len({step for _, step in found}) == 1, "longer steps lose too much: fox 0.6 dB, lego 2.9 dB"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"c2w": [1, 2]}, "c2w: expected 16 numbers, got [1,2]"),
        ({"c2w": [1, 0, 0, 1e13, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "c2w: expected 16 numbers, got"),
        ({"c2w": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 1, 2, 9, 1]}, NOT_RIGID),  # column by column
        ({"c2w": [2, 0, 0, 1, 0, 2, 0, 2, 0, 0, 2, 9, 0, 0, 0, 1]}, NOT_RIGID),  # with a scale
        ({"c2w": [-1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 9, 0, 0, 0, 1]}, NOT_RIGID),  # a mirror
        ({"c2w": [1, 0, 0, 1, 0.002, 1, 0, 2, 0, 0, 1, 9, 0, 0, 0, 1]}, NOT_RIGID),  # a shear
        ({"fx": 0}, "fx: expected a number above 0, got 0"),
        ({"width": 2.5}, "width: expected a whole number above 0, got 2.5"),
        ({"quality": "best"}, 'quality: expected exact, high, fast, got "best"'),
        ({"background": "red"}, 'background: expected [r, g, b] in 0..1 or "transparent", got "red"'),
        ({"background": [255, 255, 255]}, "background: expected [r, g, b] in 0..1"),
        ({"width": 1 << 20}, "size: expected at most"),
    ],
)
def test_views_that_are_none_are_told(
    page: RenderPage, asset: Asset, change: dict[str, Any], message: str
) -> None:
    view = view_of(scenes.cameras(asset)["outside"]) | change
    told = page.page.evaluate("view => vfr.render(view).catch((error) => error.message)", view)
    assert message in told
