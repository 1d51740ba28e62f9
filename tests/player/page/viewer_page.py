"""The page in a browser, with a renderer that records what it is asked to draw."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Route, sync_playwright

from player.page.modules import joined
from player.page.page import web_files

HERE = Path(__file__).parent
ADDRESS = "http://localhost/scene/index.html"
"""Address of the page. It is answered within the browser: nothing leaves it."""
SECONDS = 60.0
"""Longest wait for a busy machine, in seconds; a test that passes never waits that long."""
CHROMIUM = [
    "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip

RECORDER = """
import { Renderer as Real } from "./real_renderer.js";
globalThis.drawn = [];
globalThis.asked = [];
export class Renderer {
  static async create(...given) {
    const real = globalThis.renderer = await Real.create(...given);
    const { draw, depthAt } = real;
    real.draw = (view) => {
      globalThis.drawn.push(view);
      const end = performance.now() + 1000 * view.width * view.height / (globalThis.rate ?? Infinity);
      while (performance.now() < end); // a device that draws so many pixels a second
      return draw.call(real, view);
    };
    real.depthAt = (...point) => { globalThis.asked.push(point); return depthAt.apply(real, point); };
    return real;
  }
}
"""
TYPES = {
    ".js": "text/javascript",
    ".html": "text/html; charset=utf-8",
    ".css": "text/css",
    ".jpg": "image/jpeg",
}


def stub_loader(cameras: list[dict[str, Any]], fails: str = "") -> str:
    """Return a loader of a scene with these cameras and nothing to draw, or one that raises `fails`."""
    import json

    manifest = {"background": [1, 1, 1]}
    scene = json.dumps({"manifest": manifest, "cameras": cameras, "grid": {}, "problem": None})
    failure = f"throw new Error({json.dumps(fails)});" if fails else ""
    return f"""
export async function* loadScene(onProgress) {{
  onProgress({{ done: 1, total: 2 }});
  {failure}
  yield {scene};
}}"""


def page_files(loader: str, poster: bytes = b"") -> dict[str, bytes]:
    """Return the page's files with the stub renderer and this loader; its modules are joined when it is
    opened, as in an exported page."""
    files = web_files()
    html = files["index.html"]
    parts = {
        "policy": "",
        "advice": "",
        "title": "Lego",
        "style": '<link rel="stylesheet" href="style.css">',
        "poster": "poster.jpg"
        if poster
        else "data:image/gif;base64,R0lGODlhAQABAIAAAP///wAAACwAAAAAAQABAAACAkQBADs=",
        "viewer": "",
        "data": "",
        "script": '<script type="module" src="main.js"></script>',
    }
    for name, text in parts.items():
        html = html.replace(f"{{{{{name}}}}}", text)
    files |= {
        "index.html": html,
        "loader.js": loader,
        "real_renderer.js": (HERE / "stub_renderer.js").read_text(),
        "renderer.js": RECORDER,
    }
    return {name: text.encode() for name, text in files.items()} | ({"poster.jpg": poster} if poster else {})


class Opened(NamedTuple):
    page: Page
    said: list[str]
    """Messages of the console, and errors that nobody caught."""
    missing: list[str]
    """Requested addresses that are none of the page's files."""


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start a browser with WebGL on the processor."""
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.fail("expected Chromium, got none: make system-libraries installs it")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=CHROMIUM)
        yield browser
        browser.close()


@contextmanager
def opened(
    browser: Browser, files: Mapping[str, bytes], hash_: str = "", wait: bool = True, **options: Any
) -> Iterator[Opened]:
    """Open the page in a new tab; at the end, check that it logged nothing and requested only its files.

    `wait`: wait until the first whole picture is on the screen. `options`: options of a browser's context.
    """
    options = {"viewport": {"width": 640, "height": 480}, "reduced_motion": "no-preference", **options}
    context = browser.new_context(**options)
    said: list[str] = []
    missing: list[str] = []
    script = joined({name: text.decode() for name, text in files.items() if name.endswith(".js")}).encode()

    def answer(route: Route) -> None:
        path = route.request.url.removeprefix("http://localhost/scene/").partition("#")[0]
        name = path if "://" in path else path.rpartition("/")[2]  # modules lie in folders
        if name in files:
            body = script if name == "main.js" else files[name]
            route.fulfill(body=body, content_type=TYPES.get(Path(name).suffix, "application/octet-stream"))
        else:
            missing.append(route.request.url)
            route.abort()

    context.route("**/*", answer)
    page = context.new_page()
    page.set_default_timeout(SECONDS * 1000)
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(ADDRESS + hash_)
    if wait:
        page.wait_for_selector("#canvas[data-shown]")
    yield Opened(page, said, missing)
    context.close()
    assert not said and not missing


def wait_for(page: Page, what: Callable[[], object]) -> None:
    """Wait until `what()` is true."""
    end = time.monotonic() + SECONDS
    while not what():
        assert time.monotonic() < end, "waited in vain"
        page.wait_for_timeout(20)


def still(page: Page) -> dict[str, Any]:
    """Return the view of the last picture, once the camera stands still and all pictures are accumulated."""
    page.evaluate("() => { globalThis.n = -1; }")
    page.wait_for_function(
        """() => {
          const before = globalThis.before ?? 0, now = performance.now();
          if (globalThis.n !== drawn.length) [globalThis.n, globalThis.before] = [drawn.length, now];
          const done = document.getElementById("canvas").dataset.done !== undefined;
          return done && now - globalThis.before > 300 && drawn.at(-1).quality !== "fast";
        }"""
    )
    return page.evaluate("() => drawn.at(-1)")


def c2w(view: dict[str, Any]) -> np.ndarray:
    """Return the camera matrix [4, 4] of a view."""
    return np.reshape(view["c2w"], (4, 4))
