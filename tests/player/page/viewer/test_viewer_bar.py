"""Tests of the page's viewer in a browser: its bar, and the options in its address."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page

from tests.player.page.viewer.drawn_views import FILES, PHONE, VIEWS, azimuth, drag, height, matches
from tests.player.page.viewer_page import c2w, opened, still, wait_for


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


def test_a_flight_does_not_begin_backwards(chromium: Browser) -> None:
    """A flight does not begin backwards, though a frame's time may be before the click that started it."""
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        before = still(page)
        page.evaluate(
            """() => {
              const real = requestAnimationFrame;
              globalThis.requestAnimationFrame = (draw) => real((now) => draw(now - 100));
            }"""
        )
        n = page.evaluate("() => drawn.length")
        page.locator("#views").select_option(index=4)
        wait_for(page, lambda: matches(page.evaluate("() => drawn.at(-1)"), VIEWS[3]))
        way = [distance_between(before, view) for view in page.evaluate("n => drawn.slice(n)", n)]
        assert np.diff(way).min() > -1e-6


def test_the_picture_as_a_file(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off", device_scale_factor=2) as (page, *_):
        still(page)
        with page.expect_download() as download:
            page.get_by_role("button", name="Picture as PNG").click()
        assert download.value.suggested_filename == "Lego.png"
        with Image.open(Path(download.value.path())) as picture:
            assert picture.format == "PNG" and picture.size == (1280, 2 * height(page))


def test_a_picture_that_cannot_be_made_is_told(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        page.evaluate("() => { renderer.render = async () => { throw new Error('no memory'); }; }")
        page.keyboard.press("p")
        wait_for(page, lambda: page.locator("#status").text_content() == "no memory")


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


def test_the_help_card_begins_at_its_top_in_a_small_window(chromium: Browser) -> None:
    with opened(chromium, FILES, "#turn=off", viewport={"width": 600, "height": 300}) as (page, *_):
        page.keyboard.press("?")
        place = page.locator("#card").evaluate("e => [e.scrollTop, e.scrollHeight - e.clientHeight]")
        assert place[0] == 0 < place[1]


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


def test_an_address_that_changes_is_followed(chromium: Browser) -> None:
    """As when a visitor edits the address, or a page around it gives its frame another one."""
    with opened(chromium, FILES, "#turn=off") as (page, *_):
        still(page)
        page.evaluate("() => { location.hash = 'view=3&quality=exact&noui&background=255,0,0'; }")
        wait_for(page, lambda: matches(page.evaluate("() => drawn.at(-1)"), VIEWS[3]))
        view = still(page)
        assert view["quality"] == "exact" and view["background"] == [1, 0, 0]
        assert not page.locator("#bar").is_visible()
        assert page.locator("#views").evaluate("e => e.selectedIndex") == 4
        page.evaluate("() => { location.hash = 'background=transparent'; }")
        wait_for(page, lambda: page.evaluate("() => drawn.at(-1).background") == "transparent")
        view = still(page)
        assert view["quality"] == "high" and matches(view, VIEWS[3]), "it stays where it is"
        assert page.locator("#bar").is_visible() and page.locator("body.clear").count() == 1
        page.evaluate("() => { location.hash = 'turn'; }")
        wait_for(page, lambda: turns(page))
        assert page.evaluate("() => drawn.at(-1).background") == [1, 1, 1]
        assert page.locator("body.clear").count() == 0
        assert page.locator("#turn").get_attribute("aria-pressed") == "true"


def test_the_list_knows_the_view_of_the_address(chromium: Browser) -> None:
    with opened(chromium, FILES, "#view=2&turn=off") as (page, *_):
        assert page.locator("#views").evaluate("e => e.selectedIndex") == 3, "the first line is no view"
        page.keyboard.press("]")
        wait_for(page, lambda: matches(page.evaluate("() => drawn.at(-1)"), VIEWS[3]))


def test_brackets_of_keyboards_that_have_them_behind_other_keys(chromium: Browser) -> None:
    """Brackets with AltGr (Ctrl and Alt on some systems) or Option (Alt) work; with Ctrl or Cmd they are the
    browser's."""
    with opened(chromium, FILES, "#view=0&turn=off", reduced_motion="reduce") as (page, *_):
        for held, view in (("ctrlKey altKey", 1), ("altKey", 2), ("ctrlKey", 2), ("metaKey", 2)):
            page.evaluate(
                """([names, key]) => {
                  const held = Object.fromEntries(names.map((name) => [name, true]));
                  document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, ...held }));
                }""",
                [held.split(), "]"],
            )
            assert page.locator("#views").evaluate("e => e.selectedIndex") == view + 1
            assert matches(still(page), VIEWS[view])


def test_keys_of_keyboards_of_another_script(chromium: Browser) -> None:
    """A key of another script does what the Latin letter or the bracket at its place does."""
    with opened(chromium, FILES, "#view=0&turn=off", reduced_motion="reduce") as (page, *_):
        for key, code in (("п", "KeyG"), ("ъ", "BracketRight"), ("ъ", "BracketRight"), ("х", "BracketLeft")):
            page.evaluate(
                """([key, code]) => {
                  document.body.dispatchEvent(new KeyboardEvent("keydown", { key, code, bubbles: true }));
                }""",
                [key, code],
            )
        assert page.locator("#fly").get_attribute("aria-pressed") == "true"
        assert page.locator("#views").evaluate("e => e.selectedIndex") == 2
        page.keyboard.press("G")
        assert page.locator("#fly").get_attribute("aria-pressed") == "false"


def test_options_without_a_method_that_older_browsers_lack(chromium: Browser) -> None:
    files = {**FILES, "hash.js": b"delete Object.hasOwn;\n" + FILES["hash.js"]}
    for name, colour in (("black", [0, 0, 0]), ("255,0,0", [1, 0, 0]), ("toString", [1, 1, 1])):
        with opened(chromium, files, f"#background={name}") as (page, *_):
            assert page.evaluate("() => drawn.at(-1).background") == colour


def test_options_that_cannot_be_followed_are_told(chromium: Browser) -> None:
    files = {**FILES, "hash.js": b"export const optionsOf = () => { throw new Error('no options'); };"}
    with opened(chromium, files, wait=False) as (page, *_):
        page.wait_for_selector("body.failed")
        assert "cannot be shown here: no options" in page.inner_text("#status")


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
