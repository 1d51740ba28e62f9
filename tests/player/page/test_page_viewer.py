"""The page's viewer in a browser: mouse, fingers, keys, its bar, its address, and what it draws when."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page

from player.cameras.camera import Camera, focus_point, world_up
from tests.player.page.test_pose import RINGS, as_json, cameras
from tests.player.page.viewer_page import c2w, opened, page_files, still, stub_loader, wait_for

VIEWS = cameras(RINGS["an arc in front"], (1, 2, 3))
FILES = page_files(stub_loader(as_json(VIEWS)))
UP = world_up(VIEWS)
TARGET = focus_point(VIEWS)
PHONE: dict[str, Any] = {
    "viewport": {"width": 360, "height": 640},
    "device_scale_factor": 2,
    "has_touch": True,
    "is_mobile": True,
}


def distance(view: dict[str, Any]) -> float:
    return float(np.linalg.norm(c2w(view)[:3, 3] - TARGET))


def elevation(view: dict[str, Any]) -> float:
    return math.asin(c2w(view)[:3, 2] @ UP)


def azimuth(one: dict[str, Any], two: dict[str, Any]) -> float:
    """Radians by which the second camera stands further around the world's up."""
    a, b = (back - (back @ UP) * UP for back in (c2w(one)[:3, 2], c2w(two)[:3, 2]))
    return math.atan2(np.cross(a, b) @ UP, a @ b)


def pixel(view: dict[str, Any], point: np.ndarray) -> np.ndarray:
    """[2] place in the picture, pixels from its upper left corner, of a point of the world."""
    x, y, z = np.linalg.inv(c2w(view))[:3] @ [*point, 1]
    return np.array([view["cx"] + view["fx"] * x / -z, view["cy"] - view["fy"] * y / -z])


def matches(view: dict[str, Any], camera: Camera) -> bool:
    return bool(np.abs(c2w(view) - camera.c2w).max() < 1e-6)


def drag(page: Page, dx: int, dy: int, button: Any = "left") -> None:
    page.mouse.move(300, 200)
    page.mouse.down(button=button)
    page.mouse.move(300 + dx, 200 + dy, steps=5)
    page.mouse.up(button=button)


def height(page: Page) -> int:
    return page.evaluate("() => document.getElementById('canvas').clientHeight")


# --- what is drawn when ---


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
        drag(page, 30, 0)  # it finds out how fast the device is now
        still(page)
        n = page.evaluate("() => drawn.length")
        drag(page, 100, 0)
        last = still(page)
        views = page.evaluate("n => drawn.slice(n)", n)
        moving = [view for view in views if view["quality"] == "fast"]
        assert moving and not any(view["accumulate"] for view in moving)
        assert all(view["width"] * view["height"] < 1.3 * 3e6 / 30 for view in moving[3:])
        assert last["width"] == 1200 and last["height"] == height(page)
        first = next(view for view in views if view["quality"] == "high")
        assert 400 < first["width"] <= 1200, "what some tenths of a second allow"


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


# --- mouse ---


def test_a_drag_turns_around_the_scene(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        drag(page, 60, 0)
        turned = still(page)
        assert azimuth(before, turned) == pytest.approx(-60 * math.pi / height(page), rel=1e-2)
        assert distance(turned) == pytest.approx(distance(before))
        drag(page, 0, 40)
        above = still(page)
        assert elevation(above) - elevation(turned) == pytest.approx(40 * math.pi / height(page), rel=1e-2)
        np.testing.assert_allclose(pixel(above, TARGET), [above["cx"], above["cy"]], atol=1e-6)


@pytest.mark.parametrize("how", ["right", "middle", "Shift"])
def test_what_is_dragged_sideways_stays_below_the_hand(chromium: Browser, how: str) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        if how == "Shift":
            page.keyboard.down("Shift")
        drag(page, 50, 30, "left" if how == "Shift" else how)
        after = still(page)
        np.testing.assert_allclose(pixel(after, TARGET) - pixel(before, TARGET), [50, 30], atol=0.5)


def test_the_wheel_goes_nearer(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.mouse.move(300, 200)
        page.mouse.wheel(0, -300)
        near = still(page)
        assert distance(near) < 0.8 * distance(before)
        np.testing.assert_allclose(c2w(near)[:3, :3], c2w(before)[:3, :3], atol=1e-9)
        page.mouse.wheel(0, 300)
        assert distance(still(page)) == pytest.approx(distance(before))


def test_a_double_click_turns_around_what_was_hit(chromium: Browser) -> None:
    """The renderer of these tests says that it is 3 units away."""
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.mouse.dblclick(400, 150)
        wait_for(page, lambda: page.evaluate("() => asked.length") == 1)
        after = still(page)
        place = c2w(before)[:3, 3]
        ray = c2w(before)[:3, :3] @ [
            (400 - before["cx"]) / before["fx"],
            (before["cy"] - 150) / before["fy"],
            -1,
        ]
        hit = place + 3 * ray / np.linalg.norm(ray)
        np.testing.assert_allclose(pixel(after, hit), [after["cx"], after["cy"]], atol=1e-6)
        np.testing.assert_allclose(c2w(after)[:3, 3], place, atol=1e-9)
        drag(page, 60, 0)
        np.testing.assert_allclose(pixel(still(page), hit), [after["cx"], after["cy"]], atol=1e-6)
        n = page.evaluate("() => drawn.length")
        page.mouse.dblclick(5, 5)
        wait_for(page, lambda: page.evaluate("() => asked.length") == 2)
        page.wait_for_timeout(300)
        assert page.evaluate("() => drawn.length") == n, "nothing was hit there, so nothing moves"


def test_two_clicks_far_apart_are_no_double_click(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        page.mouse.click(200, 150)
        page.mouse.click(400, 150)
        page.wait_for_timeout(100)
        assert page.evaluate("() => asked.length") == 0


def test_flying_by_mouse(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.get_by_role("button", name="Fly").click()
        drag(page, 60, 0)
        looked = still(page)
        np.testing.assert_allclose(c2w(looked)[:3, 3], c2w(before)[:3, 3], atol=1e-9)
        assert azimuth(before, looked) > 0.1
        page.mouse.wheel(0, -300)
        ahead = c2w(still(page))[:3, 3] - c2w(looked)[:3, 3]
        np.testing.assert_allclose(ahead / np.linalg.norm(ahead), -c2w(looked)[:3, 2], atol=1e-9)


# --- fingers ---


def fingers(page: Page) -> Callable[..., None]:
    """touch(kind, *places): what fingers do, as the screen reports it."""
    client = page.context.new_cdp_session(page)

    def touch(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    return touch


def test_one_finger_turns_and_two_move_and_zoom(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off", **PHONE) as (page, *_):
        touch, before = fingers(page), still(page)
        touch("touchStart", (100, 100))
        for x in (120, 140, 160):
            touch("touchMove", (x, 100))
        touch("touchEnd")
        turned = still(page)
        assert azimuth(before, turned) == pytest.approx(-60 * math.pi / height(page), rel=1e-2)
        touch("touchStart", (100, 200), (200, 200))
        for step in range(1, 6):
            touch("touchMove", (100 - 10 * step, 200), (200 + 10 * step, 200))
        touch("touchEnd")
        near = still(page)
        assert distance(near) == pytest.approx(distance(turned) / 2, rel=0.02)
        touch("touchStart", (100, 200), (200, 200))
        touch("touchMove", (100, 240), (200, 240))
        touch("touchEnd")
        np.testing.assert_allclose(
            pixel(still(page), TARGET) - pixel(near, TARGET), [0, 80], atol=3
        )  # each finger alone zooms a little
        touch("touchStart", (180, 250))
        touch("touchEnd")
        touch("touchStart", (182, 251))
        touch("touchEnd")
        wait_for(page, lambda: page.evaluate("() => asked.length") == 1)


# --- keys ---


def test_keys_turn_zoom_and_fly(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)

        def pressed(key: str) -> dict[str, Any]:
            page.keyboard.press(key)
            return still(page)

        assert azimuth(before, pressed("ArrowRight")) > 0.03
        page.keyboard.press("Home")
        assert np.allclose(c2w(still(page)), c2w(before), atol=1e-9)
        assert elevation(pressed("ArrowUp")) > elevation(before) + 0.03
        assert distance(pressed("+")) < 0.97 * distance(before)
        assert distance(pressed("-")) > 0.97 * distance(before)
        at = c2w(pressed("Home"))
        for key, axis in (
            ("d", [1, 0, 0]), ("a", [-1, 0, 0]), ("e", [0, 1, 0]), ("q", [0, -1, 0]),
            ("w", [0, 0, -1]), ("s", [0, 0, 1]), ("Shift+ArrowRight", [1, 0, 0]),
        ):  # fmt: skip
            after = c2w(pressed(key))
            way = at[:3, :3].T @ (after - at)[:3, 3]
            np.testing.assert_allclose(way / np.linalg.norm(way), axis, atol=1e-6)
            at = after


def test_a_held_key_moves_until_it_is_let_go(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.keyboard.down("w")
        page.wait_for_timeout(500)
        page.keyboard.up("w")
        after = still(page)
        far = np.linalg.norm((c2w(after) - c2w(before))[:3, 3])
        assert 0.1 < far / distance(before) < 1
        n = page.evaluate("() => drawn.length")
        page.wait_for_timeout(300)
        assert page.evaluate("() => drawn.length") == n


def test_everything_works_by_keyboard_alone(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        still(page)
        reached = []
        for _ in range(12):
            page.keyboard.press("Tab")
            name = page.evaluate(
                """() => {
                  const e = document.activeElement, outline = getComputedStyle(e).outlineStyle;
                  return e === document.body ? "" : `${e.id} ${e.ariaLabel.length > 2} ${outline}`;
                }"""
            )
            if not name:
                break
            reached.append(name)
        ids = ["canvas", "before", "views", "after", "layer", "home", "turn", "fly", "save", "full", "help"]
        assert reached[:11] == [f"{name} true solid" for name in ids]
        page.locator("#canvas").focus()
        for key, layer in zip("2341", ("depth", "normals", "opacity", "colour"), strict=True):
            page.keyboard.press(key)
            assert still(page)["layer"] == layer == page.locator("#layer").input_value()
        page.keyboard.press("?")
        assert page.locator("#card").is_visible()
        page.keyboard.press("ArrowRight")  # not for the scene
        page.keyboard.press("Escape")
        assert not page.locator("#card").is_visible()
        before = still(page)
        page.locator("#views").focus()
        page.keyboard.press("ArrowDown")
        wait_for(page, lambda: matches(page.evaluate("() => drawn.at(-1)"), VIEWS[0]))
        assert not matches(before, VIEWS[0])
        page.keyboard.press("Control+2")
        assert page.locator("#layer").input_value() == "colour", "what is the browser's stays the browser's"


# --- the bar ---


def test_training_views_are_flown_to_smoothly_and_shown_exactly(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        n = page.evaluate("() => drawn.length")
        page.locator("#views").select_option(index=4)
        wait_for(page, lambda: matches(page.evaluate("() => drawn.at(-1)"), VIEWS[3]))
        after = still(page)
        assert after["fx"] / after["height"] == pytest.approx(60 / 48)
        assert after["fy"] / after["fx"] == pytest.approx(61 / 60)
        way = [distance_between(before, view) for view in page.evaluate("n => drawn.slice(n)", n)]
        assert len({round(part, 6) for part in way}) > 3, "there are views between"
        steps = np.diff(way)
        assert steps.min() > -1e-6 and steps.max() < 0.9 * distance_between(before, after)
        assert page.locator("#views").evaluate("e => e.selectedOptions[0].text").split() == ["3", "r_3"]
        page.get_by_role("button", name="Next training view").click()
        wait_for(page, lambda: matches(page.evaluate("() => drawn.at(-1)"), VIEWS[4]))
        page.keyboard.press("[")
        wait_for(page, lambda: matches(page.evaluate("() => drawn.at(-1)"), VIEWS[3]))
        drag(page, 30, 0)
        assert page.locator("#views").evaluate("e => e.selectedIndex") == 0, "it is no training view any more"
        page.get_by_role("button", name="First view").click()
        wait_for(page, lambda: np.allclose(c2w(page.evaluate("() => drawn.at(-1)")), c2w(before)))


def distance_between(one: dict[str, Any], two: dict[str, Any]) -> float:
    return float(np.abs(c2w(one) - c2w(two)).max())


def test_the_picture_as_a_file(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off", device_scale_factor=2) as (page, *_):
        still(page)
        with page.expect_download() as download:
            page.get_by_role("button", name="Picture as PNG").click()
        assert download.value.suggested_filename == "Lego.png"
        with Image.open(Path(download.value.path())) as picture:
            assert picture.format == "PNG" and picture.size == (1280, 2 * height(page))


def test_full_screen(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        page.get_by_role("button", name="Full screen").click()
        page.wait_for_function("() => document.fullscreenElement !== null")
        page.keyboard.press("f")
        page.wait_for_function("() => document.fullscreenElement === null")


@pytest.mark.parametrize(
    "window", [{"viewport": {"width": 1280, "height": 800}}, PHONE], ids=["desktop", "phone"]
)
def test_nothing_covers_the_picture(chromium: Browser, window: dict[str, Any]) -> None:
    with opened(chromium, FILES, "#turn=off", **window) as (page, *_):
        still(page)
        boxes = {name: page.locator(f"#{name}").bounding_box() for name in ("canvas", "bar")}
        canvas, bar = boxes["canvas"], boxes["bar"]
        assert canvas is not None and bar is not None
        width, tall = window["viewport"]["width"], window["viewport"]["height"]
        assert canvas["y"] == 0 and canvas["y"] + canvas["height"] <= bar["y"]
        assert bar["y"] + bar["height"] == tall and canvas["width"] == bar["width"] == width
        assert canvas["height"] > 0.84 * tall
        for button in page.locator("#bar button").all():
            box = button.bounding_box()
            assert box is not None and box["width"] >= 36 and box["height"] >= 36
            assert box["x"] >= 0 and box["x"] + box["width"] <= width


# --- the address ---


def test_options_in_the_address(chromium: Browser) -> None:
    with opened(chromium, FILES, "#view=2&quality=exact&noui&background=255,0,0") as (page, *_):
        view = still(page)
        assert matches(view, VIEWS[2]) and view["quality"] == "exact" and view["background"] == [1, 0, 0]
        assert not page.locator("#bar").is_visible() and height(page) == 480
        page.keyboard.press("?")
        assert page.locator("#card").is_visible()
    with opened(chromium, FILES, "#view=99&turn=off&background=transparent") as (page, *_):
        view = still(page)
        assert not any(matches(view, camera) for camera in VIEWS) and view["background"] == "transparent"


def turns(page: Page) -> bool:
    before = page.evaluate("() => drawn.at(-1)")
    page.wait_for_timeout(400)
    return abs(azimuth(before, page.evaluate("() => drawn.at(-1)"))) > 1e-3


def test_it_turns_until_it_is_touched(chromium: Browser) -> None:
    with opened(chromium, FILES) as (page, *_):
        wait_for(page, lambda: turns(page))
        assert page.locator("#turn").get_attribute("aria-pressed") == "true"
        page.mouse.click(300, 200)
        still(page)
        assert not turns(page) and page.locator("#turn").get_attribute("aria-pressed") == "false"
        page.keyboard.press("Space")
        assert turns(page)
        page.keyboard.press("Space")
        still(page)
        assert not turns(page)


def test_asked_to_turn_it_begins_again(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn&view=1") as (page, *_):
        wait_for(page, lambda: turns(page))
        page.mouse.click(300, 200)
        still(page)
        assert not turns(page)
        wait_for(page, lambda: turns(page))


def test_reduced_motion_is_honoured(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn", reduced_motion="reduce") as (page, *_):
        still(page)
        assert not turns(page)
        n = page.evaluate("() => drawn.length")
        page.locator("#views").select_option(index=4)
        wait_for(page, lambda: matches(page.evaluate("() => drawn.at(-1)"), VIEWS[3]))
        assert all(matches(view, VIEWS[3]) for view in page.evaluate("n => drawn.slice(n)", n)), "no flight"


# --- in another page, and where it cannot run ---


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


@pytest.mark.parametrize("why", ["no WebGL 2", "a broken file"])
def test_where_it_cannot_be_shown_the_poster_stays_and_a_sentence_says_what_to_do(
    chromium: Browser, why: str
) -> None:
    poster = (Path(__file__).parents[3] / "docs" / "fox.jpg").read_bytes()
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
    poster = (Path(__file__).parents[3] / "docs" / "fox.jpg").read_bytes()
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


def test_a_scene_that_comes_in_parts_keeps_its_poster_until_it_is_touched_or_whole(chromium: Browser) -> None:
    loader = stub_loader(as_json(VIEWS))
    scene = loader[loader.index("yield") :].partition(";")[0]
    wait = "await new Promise((go) => (globalThis.go = go));"
    loader = loader.replace(scene, f"{scene}; {wait} {scene}")
    for touched in (False, True):
        with opened(chromium, page_files(loader), "#turn=off", wait=False) as (page, *_):
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
