"""Tests of the page's viewer in a browser: what it draws when, and what happens where it cannot draw."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser

from tests.player.page.test_pose import as_json
from tests.player.page.viewer.drawn_views import FILES, TARGET, UP, VIEWS, distance, drag, height, pixel
from tests.player.page.viewer_page import c2w, opened, page_files, still, stub_loader, wait_for


def test_it_begins_level_in_the_middle_and_draws_every_pixel_of_the_screen(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off", device_scale_factor=2) as (page, *_):
        view = still(page)
        assert [view["width"], view["height"]] == [1280, 2 * height(page)]
        assert abs(c2w(view)[:3, 0] @ UP) < 1e-9 and distance(view) == pytest.approx(math.hypot(4, 0.5))
        np.testing.assert_allclose(pixel(view, TARGET), [view["width"] / 2, view["height"] / 2], atol=1e-6)
        added = [view for view in page.evaluate("() => drawn") if view["accumulate"]]
        jitters = {tuple(view["jitter"]) for view in added}
        assert len(jitters) >= 4 and all(abs(side) <= 0.5 for jitter in jitters for side in jitter)
        assert {view["width"] for view in added} == {1280}, "what is added up is whole"
        n = page.evaluate("() => drawn.length")
        page.wait_for_timeout(400)
        assert page.evaluate("() => drawn.length") == n, "nothing is drawn while nothing changes"
        assert page.locator("#status").text_content() == "" and not page.locator("#progress").is_visible()


def test_pictures_are_smaller_while_the_camera_moves(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off", viewport={"width": 1200, "height": 900}) as (page, *_):
        still(page)
        page.evaluate("() => { globalThis.rate = 3e6; }")
        drag(page, 30, 0)  # the viewer finds out how fast the device is now
        still(page)
        firsts: list[int] = []  # widths of the first pictures at rest
        while not firsts or (firsts[-1] <= 400 and len(firsts) < 3):  # a busy machine may stall one
            n = page.evaluate("() => drawn.length")
            drag(page, 100, 0)
            last = still(page)
            views = page.evaluate("n => drawn.slice(n)", n)
            moving = [view for view in views if view["quality"] == "fast"]
            assert moving and not any(view["accumulate"] for view in moving)
            assert all(view["width"] * view["height"] < 1.3 * 3e6 / 30 for view in moving[3:])
            assert last["width"] == 1200 and last["height"] == height(page)
            firsts.append(next(view["width"] for view in views if view["quality"] == "high"))
        assert 400 < firsts[-1] <= 1200, "what some tenths of a second allow"


def test_the_window_may_change_its_size(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.set_viewport_size({"width": 900, "height": 300})
        wait_for(page, lambda: page.evaluate("() => drawn.at(-1).width") == 900)
        after = still(page)
        assert after["height"] == height(page) < 300 and after["fx"] < before["fx"]
        np.testing.assert_allclose(c2w(after), c2w(before), atol=1e-12)
        page.set_viewport_size({"width": 200, "height": 20})
        wait_for(page, lambda: page.evaluate("() => drawn.at(-1).width") == 200)


SCREENS = b"""
globalThis.screens = []; // the queries for the screen's resolution, each with what hears that it has changed
const usual = matchMedia.bind(globalThis);
globalThis.matchMedia = (query) => !query.startsWith("(resolution") ? usual(query) : {
  addEventListener: (name, heard, options) => { screens.push({ query, name, heard, once: options.once }); },
};
"""
"""JavaScript that takes note of `matchMedia`: Chromium does not report that a test changes the resolution."""


def test_a_window_that_moves_to_a_screen_of_smaller_pixels_is_drawn_anew(chromium: Browser) -> None:
    files = FILES | {"renderer.js": SCREENS + FILES["renderer.js"]}
    with opened(chromium, files, "#turn=off") as (page, *_):
        before = still(page)
        client = page.context.new_cdp_session(page)
        metrics = {"width": 640, "height": 480, "deviceScaleFactor": 2, "mobile": False}
        client.send("Emulation.setDeviceMetricsOverride", metrics)
        page.evaluate("() => screens[0].heard()")
        wait_for(page, lambda: page.evaluate("() => drawn.at(-1).width") == 1280)
        after = still(page)
        assert [after["width"], after["height"]] == [2 * before["width"], 2 * before["height"]]
        asked = page.evaluate("() => screens.map(({ query, name, once }) => [query, name, once])")
        assert asked == [[f"(resolution: {ratio}dppx)", "change", True] for ratio in (1, 2)]


def test_layers_that_are_not_added_up_are_drawn_once_at_full_size(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        still(page)
        page.keyboard.press("2")
        wait_for(page, lambda: page.evaluate("() => drawn.at(-1).layer") == "depth")
        assert still(page)["width"] == 640
        whole = page.evaluate("() => drawn.filter((view) => view.layer === 'depth' && view.accumulate)")
        assert len(whole) == 1


HIDDEN = [
    "() => document.dispatchEvent(new Event('visibilitychange'))",
    "() => { renderer.gl.canvas.style.transform = 'translateY(-5000px)'; }",  # as when an iframe is scrolled
]


@pytest.mark.parametrize("hide", HIDDEN)
def test_a_page_that_is_hidden_while_a_picture_is_drawn_is_sharp_afterwards(
    hide: str, chromium: Browser
) -> None:
    """The time away does not count as the time that the first picture at rest took, on which the size of the
    next one depends."""
    with opened(chromium, FILES, "#turn=off", viewport={"width": 1200, "height": 900}) as (page, *_):
        page.evaluate("() => { globalThis.rate = 5e5; }")
        drag(page, 30, 0)
        before = still(page)
        n = page.evaluate("() => drawn.length")
        page.evaluate(
            """n => {
          const { gl } = renderer, asked = gl.getSyncParameter;
          gl.getSyncParameter = (...of) => drawn.length < n + 2 ? asked.apply(gl, of) : gl.UNSIGNALED;
        }""",
            n,
        )
        page.keyboard.press("3")
        page.wait_for_function("n => drawn.length === n + 2", arg=n)
        page.evaluate(hide)
        page.wait_for_timeout(3000)  # in which nothing is drawn
        assert page.evaluate("() => drawn.length") == n + 2
        page.evaluate("() => { delete renderer.gl.getSyncParameter; }")
        after = still(page)
        assert [before["width"], before["height"]] == [1200, height(page)]
        assert [after["width"], after["height"]] == [1200, height(page)]


def test_a_finer_scene_and_a_lost_context(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        still(page)
        page.evaluate(
            "() => { globalThis.gl = renderer.gl.getExtension('WEBGL_lose_context'); gl.loseContext(); }"
        )
        page.wait_for_function("() => document.getElementById('status').textContent.includes('come back')")
        n = page.evaluate("() => drawn.length")
        drag(page, 40, 0)
        page.wait_for_timeout(200)
        assert page.evaluate("() => drawn.length") == n, "nothing is drawn meanwhile"
        page.evaluate("() => gl.restoreContext()")
        page.wait_for_function("n => drawn.length > n", arg=n)
        still(page)
        assert page.locator("#status").text_content() == ""


def test_embedded_it_takes_the_wheel_once_it_was_clicked(chromium: Browser) -> None:
    outer = b"<!doctype html><style>body{height:3000px}</style>"
    outer += b"<iframe src='index.html#turn=off' width=500 height=300>"
    with opened(chromium, {**FILES, "outer.html": outer}, wait=False) as (page, *_):
        page.goto("http://localhost/scene/outer.html")
        frame = page.frames[1]
        frame.wait_for_selector("#canvas[data-shown]")
        still(frame)  # type: ignore[arg-type]
        n = frame.evaluate("() => drawn.length")
        page.mouse.move(200, 100)
        page.mouse.wheel(0, 200)
        page.wait_for_function("() => scrollY > 0")
        assert frame.evaluate("() => drawn.length") == n
        page.evaluate("() => scrollTo(0, 0)")
        page.mouse.click(200, 100)
        page.mouse.wheel(0, 200)
        frame.wait_for_function("n => drawn.length > n", arg=n)
        assert page.evaluate("() => scrollY") == 0


def test_embedded_with_a_transparent_background_it_shows_the_page_around_it(chromium: Browser) -> None:
    """A frame is opaque if its colour scheme is not that of the page around it, as on a dark system."""
    outer = b"<!doctype html><body style='margin: 0; background: #0f0'><iframe width=500 height=300 "
    outer += b"style='border: 0' src='index.html#turn=off&noui&background=transparent'></iframe>"
    files = {**FILES, "outer.html": outer}
    with opened(chromium, files, wait=False, color_scheme="dark") as (page, *_):
        page.goto("http://localhost/scene/outer.html")
        frame = page.frames[1]
        frame.wait_for_selector("#canvas[data-done]")
        assert frame.evaluate("() => getComputedStyle(document.documentElement).colorScheme") == "light"
        with Image.open(io.BytesIO(page.screenshot())) as picture:
            assert picture.convert("RGB").getpixel((5, 5)) == (0, 255, 0)


@pytest.mark.parametrize("why", ["no WebGL 2", "a broken file"])
def test_where_it_cannot_be_shown_the_poster_stays_and_a_sentence_says_what_to_do(
    chromium: Browser, why: str
) -> None:
    poster = (Path(__file__).parents[4] / "docs" / "fox.jpg").read_bytes()
    files = page_files(stub_loader(as_json(VIEWS), "" if "WebGL" in why else why), poster)
    if "WebGL" in why:
        files["real_renderer.js"] = files["real_renderer.js"].replace(b'"webgl2"', b'"webgl3"')
    with opened(chromium, files, wait=False) as (page, *_):
        page.wait_for_selector("body.failed")
        said = page.locator("#status").text_content() or ""
        assert said.startswith("This scene cannot be shown here: ")
        assert ("Open this page in a current Chrome" if "WebGL" in why else "load the page again") in said
        assert why in said or "WebGL 2" in said
        box, line = page.locator("#poster").bounding_box(), page.locator("#status").bounding_box()
        assert box is not None and line is not None and box["height"] > 200
        assert box["y"] + box["height"] <= line["y"], "the sentence is below the poster"
        assert not page.locator("#bar").is_visible() and not page.locator("#progress").is_visible()
        assert page.evaluate("() => document.getElementById('poster').naturalWidth") > 0


def test_the_poster_is_there_before_the_scene_is(chromium: Browser) -> None:
    poster = (Path(__file__).parents[4] / "docs" / "fox.jpg").read_bytes()
    loader = stub_loader(as_json(VIEWS)).replace(
        "onProgress({", "await new Promise((go) => (globalThis.go = go)); onProgress({"
    )
    loader = loader.replace("onProgress({", "onProgress({ done: 1, total: 4 }); onProgress({", 1)
    with opened(chromium, page_files(loader, poster), wait=False) as (page, *_):
        page.wait_for_function("() => globalThis.go")
        assert page.locator("#status").text_content() == "Loading…" and page.locator("#progress").is_visible()
        assert page.evaluate("() => getComputedStyle(document.getElementById('canvas')).opacity") == "0"
        assert page.locator("#poster").is_visible()
        page.evaluate("() => go()")
        page.wait_for_selector("#canvas[data-shown]")


def loader_of_parts(first: str = "{}") -> str:
    """Return a loader that yields a scene whose grid is `first` and, after `go()`, a finer scene."""
    loader = stub_loader(as_json(VIEWS))
    scene = loader[loader.index("yield") :].partition(";")[0]
    begun = scene.replace('"grid": {}', f'"grid": {first}')
    finer = scene.replace('"grid"', '"isFiner": true, "grid"')
    wait = "await new Promise((go) => (globalThis.go = go));"
    return loader.replace(scene, f"{begun}; {wait} {finer}")


def test_a_scene_that_comes_in_parts_keeps_its_poster_until_it_is_touched_or_whole(chromium: Browser) -> None:
    files = page_files(loader_of_parts())
    for touched in (False, True):
        with opened(chromium, files, "#turn=off", wait=False) as (page, *_):
            page.wait_for_function("() => globalThis.go")
            page.wait_for_timeout(300)
            assert page.evaluate("() => drawn.length") == 0 and page.locator("#progress").is_visible()
            if touched:
                drag(page, 60, 0)
                turned = still(page)
                assert page.locator("#progress").is_visible()
            page.evaluate("() => go()")
            page.wait_for_selector("#canvas[data-shown]")
            after = still(page)
            assert not page.locator("#progress").is_visible()
            if touched:
                np.testing.assert_allclose(c2w(after), c2w(turned), atol=1e-12)


def test_a_finer_scene_that_does_not_fit_leaves_the_coarse_one(chromium: Browser) -> None:
    files = page_files(loader_of_parts())
    stub, why = files["real_renderer.js"], "memory of the GPU: expected enough for this scene, got too little"
    fails = f"if (scene.isFiner) throw new Error('{why}');".encode()
    files["real_renderer.js"] = stub.replace(b"this.scene = scene;", fails + b" this.scene = scene;")
    with opened(chromium, files, "#turn=off", wait=False) as (page, *_):
        page.wait_for_function("() => globalThis.go")
        page.evaluate("() => go()")
        page.wait_for_selector("#canvas[data-done]")
        said = page.locator("#status").text_content() or ""
        assert said.startswith(f"This scene cannot be shown whole here: {why}. Open this page in a current")
        assert page.locator("#bar").is_visible() and not page.locator("#progress").is_visible()
        assert page.evaluate("() => vfr.ready.then(() => null, (error) => error.message)") == why


def test_a_scene_that_lacks_a_part_is_shown_but_is_not_ready(chromium: Browser) -> None:
    why = "part_1.bin: expected 5 bytes, got 3: shown as the first 1 of 2 parts have it"
    before, _, behind = loader_of_parts().rpartition('"problem": null')
    files = page_files(f'{before}"problem": "{why}"{behind}')
    with opened(chromium, files, "#turn=off", wait=False) as (page, *_):
        page.wait_for_function("() => globalThis.go")
        page.evaluate("() => go()")
        page.wait_for_selector("#canvas[data-done]")
        assert page.locator("#status").text_content() == why and page.locator("#bar").is_visible()
        for asked in ("vfr.ready", "vfr.render({})"):
            assert page.evaluate(f"() => {asked}.then(() => null, (error) => error.message)") == why


@pytest.mark.parametrize("first", ["{}", "null"], ids=["after the first part", "before the first part"])
def test_a_context_that_is_lost_while_the_scene_arrives(chromium: Browser, first: str) -> None:
    with opened(chromium, page_files(loader_of_parts(first)), "#turn=off", wait=False) as (page, *_):
        page.wait_for_function("() => globalThis.go && globalThis.renderer")
        page.evaluate(
            "() => { globalThis.gl = renderer.gl.getExtension('WEBGL_lose_context'); gl.loseContext(); }"
        )
        page.wait_for_function("() => document.getElementById('status').textContent.includes('come back')")
        page.evaluate("async () => { go(); await vfr.ready; }")
        page.wait_for_timeout(200)
        assert "come back" in (page.locator("#status").text_content() or "")
        assert page.evaluate("() => drawn.length") == 0
        page.evaluate("() => gl.restoreContext()")
        page.wait_for_selector("#canvas[data-done]")
        assert page.locator("#status").text_content() == ""
