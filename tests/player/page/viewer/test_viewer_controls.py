"""Tests of the page's viewer in a browser: mouse, fingers and keys."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from tests.player.page.viewer.drawn_views import (
    FILES,
    PHONE,
    TARGET,
    VIEWS,
    azimuth,
    distance,
    drag,
    elevation,
    height,
    matches,
    pixel,
)
from tests.player.page.viewer_page import c2w, opened, still, wait_for


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


def test_a_pinch_on_a_touch_pad_in_safari_goes_nearer(chromium: Browser) -> None:
    """Safari on macOS tells of it by events of its own; on a screen, where fingers are pointers, too."""
    pinch = """(scales) => scales.forEach((scale, i) => {
      const event = new Event(i ? "gesturechange" : "gesturestart", { cancelable: true });
      canvas.dispatchEvent(Object.assign(event, { scale }));
      (globalThis.prevented ??= []).push(event.defaultPrevented);
    })"""
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.evaluate(pinch, [1, 1.25, 2])
        assert distance(near := still(page)) == pytest.approx(distance(before) / 2)
        page.evaluate(pinch, [1, 0.8])
        assert distance(away := still(page)) == pytest.approx(distance(near) / 0.8)
        assert page.evaluate("() => prevented") == [True] * 5, "Safari does not zoom the page"
        page.mouse.move(300, 200)
        page.mouse.down()
        page.evaluate(pinch, [1, 2])
        page.mouse.up()
        assert distance(still(page)) == pytest.approx(distance(away))


def hit_at(view: dict[str, Any], x: float, y: float) -> np.ndarray:
    """Return the point [3] at a pixel of a view, 3 units away, as the stub renderer of these tests has it."""
    ray = c2w(view)[:3, :3] @ [(x - view["cx"]) / view["fx"], (view["cy"] - y) / view["fy"], -1]
    return c2w(view)[:3, 3] + 3 * ray / np.linalg.norm(ray)


def test_a_double_click_turns_around_what_was_hit(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.mouse.dblclick(400, 150)
        wait_for(page, lambda: page.evaluate("() => asked.length") == 1)
        after = still(page)
        place, hit = c2w(before)[:3, 3], hit_at(before, 400, 150)
        np.testing.assert_allclose(pixel(after, hit), [after["cx"], after["cy"]], atol=1e-6)
        np.testing.assert_allclose(c2w(after)[:3, 3], place, atol=1e-9)
        drag(page, 60, 0)
        np.testing.assert_allclose(pixel(still(page), hit), [after["cx"], after["cy"]], atol=1e-6)
        n = page.evaluate("() => drawn.length")
        page.mouse.dblclick(5, 5)
        wait_for(page, lambda: page.evaluate("() => asked.length") == 2)
        page.wait_for_timeout(300)
        assert page.evaluate("() => drawn.length") == n, "nothing was hit there, so nothing moves"


def test_a_key_turns_around_what_is_in_the_middle(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.keyboard.press("c")
        wait_for(page, lambda: page.evaluate("() => asked.length") == 1)
        after, hit = still(page), hit_at(before, before["width"] / 2, before["height"] / 2)
        np.testing.assert_allclose(pixel(after, hit), [after["cx"], after["cy"]], atol=1e-6)
        np.testing.assert_allclose(c2w(after)[:3, 3], c2w(before)[:3, 3], atol=1e-9)
        drag(page, 60, 0)
        np.testing.assert_allclose(pixel(still(page), hit), [after["cx"], after["cy"]], atol=1e-6)


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


def fingers(page: Page) -> Callable[..., None]:
    """Return touch(kind, *places), which reports to the page what fingers do on the screen."""
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


def test_embedded_fingers_scroll_the_page_around_it_until_it_is_tapped(chromium: Browser) -> None:
    outer = (
        b"<!doctype html><meta name=viewport content='width=device-width'><style>body{height:3000px}</style>"
    )
    outer += b"<iframe src='index.html#turn=off' width=300 height=300></iframe>"
    with opened(chromium, {**FILES, "outer.html": outer}, wait=False, **PHONE) as (page, *_):
        page.goto("http://localhost/scene/outer.html")
        frame = page.frames[1]
        frame.wait_for_selector("#canvas[data-done]")
        touch, n = fingers(page), frame.evaluate("() => drawn.length")

        def drag_up() -> None:
            touch("touchStart", (150, 200))
            for y in range(190, 90, -10):
                touch("touchMove", (150, y))
            touch("touchEnd")

        page.evaluate("() => addEventListener('scrollend', () => (globalThis.isStill = true))")
        drag_up()
        page.wait_for_function(
            "() => globalThis.isStill && scrollY > 50"
        )  # a tap would only end the scrolling
        assert frame.evaluate("() => drawn.length") == n
        page.evaluate("() => scrollTo(0, 0)")
        touch("touchStart", (150, 150))
        touch("touchEnd")
        frame.wait_for_function("() => document.getElementById('canvas').style.touchAction === 'none'")
        drag_up()
        frame.wait_for_function("n => drawn.length > n", arg=n)
        assert page.evaluate("() => scrollY") == 0


def test_an_embedded_page_that_fills_the_screen_takes_the_wheel(chromium: Browser) -> None:
    outer = b"<iframe src='index.html#turn=off' allow=fullscreen width=600 height=400></iframe>"
    with opened(chromium, {**FILES, "outer.html": outer}, wait=False) as (page, *_):
        page.goto("http://localhost/scene/outer.html")
        frame = page.frames[1]
        frame.wait_for_selector("#canvas[data-done]")
        frame.get_by_role("button", name="Full screen").click()
        frame.wait_for_function("() => document.getElementById('canvas').style.touchAction === 'none'")
        before = frame.evaluate("() => drawn.at(-1).c2w")
        page.mouse.move(300, 200)
        page.mouse.wheel(0, -300)
        frame.wait_for_function("before => drawn.at(-1).c2w.some((x, i) => x !== before[i])", arg=before)


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
        near = pressed("+")  # more than one tap's zoom if a busy machine lets the key up late
        assert distance(near) < 0.97 * distance(before)
        assert distance(pressed("-")) > 1.03 * distance(near)
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


@pytest.mark.parametrize(
    ("held", "let_go"),
    [({"key": "ArrowLeft"}, {"key": "ArrowLeft"}), ({"key": "w", "code": "KeyW"}, {"key": "Meta"})],
    ids=["no code", "let go while Cmd is held"],
)
def test_a_key_that_is_let_go_otherwise(
    chromium: Browser, held: dict[str, str], let_go: dict[str, str]
) -> None:
    """Some devices send keys without a code; macOS does not tell of a key that is let go while Cmd is held,
    only of Cmd itself."""
    send = "([type, key]) => { dispatchEvent(new KeyboardEvent(type, key)); }"
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.evaluate(send, ["keydown", held])
        page.evaluate(send, ["keyup", let_go])
        after = still(page)
        assert not np.allclose(c2w(after), c2w(before))
        n = page.evaluate("() => drawn.length")
        page.wait_for_timeout(300)
        assert page.evaluate("() => drawn.length") == n, "it stands still"


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
        page.keyboard.press("ArrowRight")  # the card is open: not for the scene
        page.keyboard.press("Escape")
        assert not page.locator("#card").is_visible()
        before = still(page)
        page.locator("#views").focus()
        page.keyboard.press("ArrowDown")
        wait_for(page, lambda: matches(page.evaluate("() => drawn.at(-1)"), VIEWS[0]))
        assert not matches(before, VIEWS[0])
        page.keyboard.press("Control+2")
        assert page.locator("#layer").input_value() == "colour", "what is the browser's stays the browser's"
