"""Tests of the page as it is put together: its data survives, its policy names its scripts, and it plays."""

from __future__ import annotations

import base64
import hashlib
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Route

from exporters.export import export_asset
from player.app.option_types import DEMO
from player.asset.asset import Asset
from player.errors import ConfigError, FormatError
from player.page import page
from player.page.gpu_memory import MOST_CHANNELS
from player.page.page import WebPage, page_of_many_files, page_of_one_file, page_script, web_files
from player.page.scene_files import scene_files
from player.page.text_bytes import ALPHABET, bytes_of_text, text_of_bytes
from tests.player.page import scenes

SECONDS = 120
MOST_VIEWER = 60_000
"""Most bytes of a page without its data and poster."""


class Opened(NamedTuple):
    page: Page
    said: list[str]
    """Messages of the console, and errors that nobody caught."""
    asked: list[str]
    """Addresses that were requested."""


@contextmanager
def opened(
    browser: Browser, address: str, answers: dict[str, tuple[bytes, str]] | None = None, offline: bool = True
) -> Iterator[Opened]:
    """Open a page without a network, except for `answers`: content and its type by address."""
    offline = offline and answers is None
    context = browser.new_context(offline=offline, viewport={"width": 160, "height": 120})
    found = Opened(context.new_page(), [], [])
    found.page.set_default_timeout(SECONDS * 1000)
    found.page.on("console", lambda message: found.said.append(message.text))
    found.page.on("pageerror", lambda error: found.said.append(str(error)))
    found.page.on("request", lambda request: found.asked.append(request.url))
    if answers is not None:
        context.route("**/*", lambda route: answer(route, answers))
    found.page.goto(address)
    yield found
    context.close()


def answer(route: Route, answers: dict[str, tuple[bytes, str]]) -> None:
    known = answers.get(route.request.url.partition("?")[0])
    if known is None:
        route.abort()
    else:
        route.fulfill(body=known[0], content_type=known[1])


# --- bytes as text ---


def test_text_is_plain_and_comes_back() -> None:
    assert len(ALPHABET) == 116 and not set(ALPHABET) & set(b"\0\n\r<&'\"")
    random = np.random.default_rng(0)
    for length in (0, 1, 5, 6, 7, 4096):
        for data in (bytes(length), b"\xff" * length, random.bytes(length)):
            text = text_of_bytes(data)
            assert len(text) == -(-length // 6) * 7 and set(text) <= set(ALPHABET)
            assert bytes_of_text(text)[:length] == data
    number = sum(byte << 8 * i for i, byte in enumerate(b"\x01\x80\xfe\xff\r\n"))
    digits = [ALPHABET.index(letter) for letter in text_of_bytes(b"\x01\x80\xfe\xff\r\n")]
    assert sum(digit * 116**i for i, digit in enumerate(digits)) == number
    with pytest.raises(ValueError, match="alphabet"):
        bytes_of_text(b"<" * 7)


READ = """
import { bytesOf } from "./text_bytes.js";
globalThis.read = (length) => {
  const bytes = bytesOf(document.getElementById("data").textContent, length);
  return bytes && btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
};
"""


@pytest.mark.parametrize("charset", ["", "; charset=utf-8", "; charset=windows-1252", "; charset=shift_jis"])
def test_every_byte_survives_in_a_browser(chromium: Browser, charset: str) -> None:
    """All pairs of bytes, at all places of a group, survive whatever charset a server claims."""
    pairs = np.stack(np.meshgrid(np.arange(256), np.arange(256)), axis=-1).astype(np.uint8).tobytes()
    data = b"".join(bytes(n) + pairs for n in range(6)) + b"</script><!--\r\n\r\0"
    script = page_script({**web_files(), "main.js": READ}, "main.js", "main.js")
    html = f'<!doctype html><script type="module">{script}</script><script type="text/plain" id="data">'
    address = "http://scene.test/"
    answers = {address: (html.encode() + text_of_bytes(data) + b"</script>", f"text/html{charset}")}
    with opened(chromium, address, answers) as found:
        assert base64.b64decode(found.page.evaluate("n => read(n)", len(data))) == data
        assert found.page.evaluate("n => read(n)", len(data) + 6) is None
        assert found.said == []


# --- the page ---


@pytest.mark.parametrize(("make", "beside"), [(page_of_one_file, "'none'"), (page_of_many_files, "'self'")])
def test_a_page_is_plain_and_names_what_runs(asset: Asset, make: Callable[..., WebPage], beside: str) -> None:
    made = make(asset, title='</title><script>alert("x")</script>')
    text = made.files["index.html"].decode("ascii")
    before, _, behind = text.partition("</title>")
    assert before.endswith("<title>&lt;/title&gt;&lt;script&gt;alert(&quot;x&quot;)&lt;/script&gt;")
    assert "alert(" not in behind and '<link rel="icon" href="data:,">' in behind, "no request for an icon"
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    rules = dict(rule.strip().partition(" ")[::2] for rule in policy.split(";"))
    assert rules["default-src"] == "'none'" and rules["connect-src"] == beside and "unsafe" not in policy
    assert rules["worker-src"] == "blob:" and ("'self'" in rules["img-src"]) == (beside == "'self'")
    named = set(rules["script-src"].split()) | set(rules["style-src"].split())
    scripts = re.findall(r'<script type="module">(.*?)</script>', text, re.DOTALL)
    styles = re.findall(r"<style>(.*?)</style>", text, re.DOTALL)
    whole = page_script(web_files())
    digests = [hashlib.sha256(some.encode()).digest() for some in (*scripts, *styles, whole)]
    assert named == {f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests}
    assert len(scripts) == len(styles) == 1
    if make is page_of_many_files:
        text, n = re.subn(r'data-advice="[^"]+"|src="poster\.jpg\?v=\w+"', "", text)
        assert n == 2
    assert not re.search(r"""(src|href)=["'](?!data:)|https?://|@import|url\(|\son\w+=|\sstyle=""", text)
    data = sum(map(len, scene_files(asset).values()))
    assert sum(map(len, made.files.values())) < 1.35 * (data + made.viewer_bytes + 50_000)


def test_the_viewer_is_small() -> None:
    """The viewer is small: all of a page but the poster's text and those of the data."""
    asset = Asset.open(DEMO)
    one, many = page_of_one_file(asset), page_of_many_files(asset)
    text = one.files["index.html"]
    found = re.findall(rb'data:image/jpeg;base64,([^"]*)|<script[^>]* data-file="[^>]*>([^<]*)<', text)
    assert len(found) == 1 + len(scene_files(asset))
    assert len(text) - sum(len(some) for each in found for some in each) == one.viewer_bytes <= MOST_VIEWER
    others = {name: data for name, data in many.files.items() if name not in scene_files(asset)}
    del others["poster.jpg"]
    assert sum(map(len, others.values())) == many.viewer_bytes <= MOST_VIEWER


def test_a_title_may_hold_what_the_page_fills_in(asset: Asset) -> None:
    title = "{{data}} of {{title}}"
    for make in (page_of_one_file, page_of_many_files):
        assert f"<title>{title}</title>".encode() in make(asset, title).files["index.html"]


def test_the_data_is_what_the_asset_has(asset: Asset, tmp_path: Path) -> None:
    """A page has the asset's data without what no page needs: the mesh, reports and settings of the bake."""
    files = scene_files(asset)
    assert files["part_0.bin"] == asset.read("part_0.bin")
    assert not {"mesh.ply", "head.onnx"} & set(files)
    assert b"psnr" not in files["manifest.json"] and b"psnr" in (asset.folder / "manifest.json").read_bytes()
    facts = export_asset(asset.folder, tmp_path / "scene.html")
    assert facts["bytes"] == (tmp_path / "scene.html").stat().st_size
    assert (tmp_path / "scene.html").read_bytes() == page(Asset.open(asset.folder))


def test_more_channels_than_browsers_draw_are_refused(chromium: Browser, tmp_path: Path) -> None:
    """The most channels that are allowed are drawn, by a browser with as many draw buffers as most have; one
    more is refused."""
    path = tmp_path / "scene.html"
    path.write_bytes(page(scenes.empty(tmp_path / "most", MOST_CHANNELS)))
    with opened(chromium, path.as_uri()) as found:
        assert found.page.evaluate("() => vfr.ready.then(() => vfr.info.n_channels)") == MOST_CHANNELS == 40
    asset = scenes.empty(tmp_path / "more", MOST_CHANNELS + 1)
    for make in (page_of_one_file, page_of_many_files):
        with pytest.raises(ConfigError, match=r"channels: expected at most 40, .*, got 41: bake it with"):
            make(asset)


def test_an_asset_that_lacks_a_part_is_refused(broken_folder: Path, tmp_path: Path) -> None:
    """An asset that lacks a part is refused: the player shows what is there, but a page must be complete."""
    (broken_folder / "part_0.bin").unlink()
    with pytest.raises(FormatError, match=r"part_0\.bin"):
        export_asset(broken_folder, tmp_path / "scene.html")


PLAYS = """async () => {
  const early = typeof window.vfr.render;
  await vfr.ready;
  const c2w = [1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 9, 0, 0, 0, 1];
  const view = { c2w, fx: 40, fy: 40, cx: 20, cy: 15, width: 40, height: 30, background: [0, 0, 1] };
  const { width, height, rgba } = await vfr.render(view);
  const [corner, middle] = [0, 620].map((pixel) => [...rgba.slice(4 * pixel, 4 * pixel + 4)]);
  return { early, width, height, corner, middle };
}"""


EARLY = """
document.addEventListener("DOMContentLoaded", () => {
  const c2w = [1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 9, 0, 0, 0, 1];
  const view = { c2w, fx: 40, fy: 40, cx: 20, cy: 15, width: 40, height: 30, background: [0, 0, 1] };
  window.early = vfr.render(view).then(({ rgba }) => [...rgba.slice(0, 4)]);
  view.background[0] = 1;
});
"""


def check_plays(found: Opened) -> None:
    found.page.wait_for_selector("#canvas[data-shown]")
    played = found.page.evaluate(PLAYS)
    assert (played["early"], played["width"], played["height"]) == ("function", 40, 30)
    assert played["corner"] == [0, 0, 255, 255] and played["middle"] != played["corner"]
    assert [line for line in found.said if "GPU stall due to ReadPixels" not in line] == []


def test_a_picture_that_is_asked_for_early_shows_the_view_of_then(
    chromium: Browser, asset: Asset, tmp_path: Path
) -> None:
    path = tmp_path / "scene.html"
    path.write_bytes(page(asset))
    with chromium.new_context(offline=True) as context:
        context.add_init_script(EARLY)
        found = context.new_page()
        found.set_default_timeout(SECONDS * 1000)
        found.goto(path.as_uri())
        assert found.evaluate("() => early") == [0, 0, 255, 255]


def test_a_page_plays_from_a_disk(chromium: Browser, asset: Asset, tmp_path: Path) -> None:
    path = tmp_path / "scene.html"
    path.write_bytes(page(asset))
    with opened(chromium, path.as_uri()) as found:
        assert found.page.evaluate("() => typeof vfr.ready.then") == "function"
        assert found.page.title() == asset.folder.name
        check_plays(found)
        assert [url for url in found.asked if not url.startswith(("blob:", "data:"))] == [path.as_uri()]


SITE = "http://localhost/scene/"


def site(asset: Asset, module: str = "main.js", before: str = "") -> dict[str, tuple[bytes, str]]:
    """Return what a server at SITE answers; `module` begins with the lines `before`."""
    kinds = {".html": "text/html", ".jpg": "image/jpeg"}
    sources = web_files()
    sources[module] = before + sources[module]
    with patch.dict(page_of_many_files.__globals__, web_files=lambda: sources):
        files = page_of_many_files(asset).files
    answers = {
        SITE + name: (data, kinds.get(Path(name).suffix, "application/octet-stream"))
        for name, data in files.items()
    }
    return {SITE: answers[SITE + "index.html"], **answers}


def test_a_site_plays_from_a_server(chromium: Browser, asset: Asset) -> None:
    answers = site(asset)
    with opened(chromium, SITE, answers) as found:
        check_plays(found)
        asked = {url.partition("?")[0] for url in found.asked if not url.startswith("blob:")}
        assert asked == set(answers) - {SITE + "index.html"}


class Server(SimpleHTTPRequestHandler):
    """A server that, as many do, says when a file was written but not how long a browser may keep it."""

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder; yield its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Server, directory=str(folder))) as server:
        Thread(target=server.serve_forever).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()


def test_a_site_that_is_exported_again_shows_the_new_scene(
    chromium: Browser, asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Browsers keep each file for a tenth of its age, if the server does not say for how long."""
    folder = tmp_path / "site"
    folder.mkdir()

    def export(some: Asset, time: int) -> None:
        for name, data in page_of_many_files(some).files.items():
            (folder / name).write_bytes(data)
            os.utime(folder / name, (time, time))

    export(asset, 1_000_000_000)
    with served(folder) as address, opened(chromium, address, offline=False) as found:
        n_channels = "() => vfr.ready.then(() => vfr.info.n_channels)"
        assert found.page.evaluate(n_channels) == 4
        files = web_files()
        files["main.js"] = 'document.title = "new";\n' + files["main.js"]
        monkeypatch.setitem(page_of_many_files.__globals__, "web_files", lambda: files)
        export(scenes.empty(tmp_path / "asset", 5), 1_000_000_001)
        found.page.reload()
        assert found.page.evaluate(n_channels) == 5
        assert found.page.title() == "new"
        assert len({url for url in found.asked if url.startswith(address + "poster.jpg")}) == 2


@pytest.mark.parametrize("where", ["on a disk", "without its slash", "where another page answers"])
def test_a_folder_whose_scene_is_not_found_says_what_to_do(
    chromium: Browser, asset: Asset, tmp_path: Path, where: str
) -> None:
    address, answers = SITE, site(asset)
    if where == "on a disk":
        for name, data in page_of_many_files(asset).files.items():
            (tmp_path / name).write_bytes(data)
        address, answers = (tmp_path / "index.html").as_uri(), None
    elif where == "without its slash":
        address = SITE.removesuffix("/")
        answers[address] = answers[SITE]
    else:
        answers[SITE + "manifest.json"] = answers[SITE]
    with opened(chromium, address, answers) as found:
        found.page.wait_for_selector("body.failed")
        said = found.page.inner_text("#status")
        told = found.page.evaluate("() => vfr.ready.then(() => null, (error) => error.message)")
    assert told.startswith("manifest.json: expected ") and told in said
    for advice in ("python -m http.server", "scene as one file", "must end in a slash"):
        assert advice in said


def test_a_folder_that_lacks_another_file_is_not_said_to_lack_a_server(
    chromium: Browser, asset: Asset
) -> None:
    answers = site(asset)
    del answers[SITE + "cameras.json"]
    with opened(chromium, SITE, answers) as found:
        found.page.wait_for_selector("body.failed")
        said = found.page.inner_text("#status")
    assert "cameras.json: expected it beside the page, got no answer" in said
    assert "load the page again" in said and "http.server" not in said


@pytest.mark.parametrize("before", ["(\n", "throw 1;\n"], ids=["parse", "run"])
def test_a_site_whose_script_fails_says_what_to_do(chromium: Browser, asset: Asset, before: str) -> None:
    with opened(chromium, SITE, site(asset, "loader.js", before)) as found:
        check_advises_another_device(found)


@pytest.mark.parametrize("kind", ["one file", "a folder"])
def test_a_page_that_is_still_arriving_only_says_that_it_loads(
    chromium: Browser, asset: Asset, kind: str
) -> None:
    """A module that has another type does not run, as on a slow line before all of the page has arrived."""
    answers = site(asset)
    html = page(asset) if kind == "one file" else answers[SITE][0]
    arriving, n = re.subn(rb'<script type="module"', b'<script type="text/plain"', html)
    assert n == 1
    with opened(chromium, SITE, {**answers, SITE: (arriving, "text/html")}) as found:
        found.page.evaluate("() => document.getAnimations().forEach((each) => each.finish())")
        assert found.page.inner_text("#status").strip() == "Loading…"


def test_a_scene_that_cannot_be_shown_is_not_loaded_further(chromium: Browser, asset: Asset) -> None:
    with opened(chromium, "about:blank", site(asset)) as found:
        found.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null;")
        found.page.route(SITE + "part_0.bin", lambda route: None)  # it never arrives
        with found.page.expect_event("requestfailed", lambda request: request.url == SITE + "part_0.bin"):
            found.page.goto(SITE)
        found.page.wait_for_selector("body.failed")


def check_advises_another_device(found: Opened) -> str:
    """Check that the page says what to open it in, not to load it again; return what it says."""
    found.page.wait_for_selector("body.failed")
    said = found.page.inner_text("#status")
    assert "Open this page in a current" in said and "again" not in said
    return said


def test_a_site_in_a_browser_that_cannot_decode_it_names_others(chromium: Browser, asset: Asset) -> None:
    answers = site(asset, "worker.js", "delete self.DecompressionStream;\n")
    with opened(chromium, SITE, answers) as found:
        said = check_advises_another_device(found)
        assert "expected a browser with DecompressionStream, got an older one" in said


def test_a_scene_that_takes_too_much_memory_to_decode_asks_for_another_device(
    chromium: Browser, asset: Asset
) -> None:
    answers = site(asset)
    manifest, kind = answers[SITE + "manifest.json"]
    manifest = re.sub(rb'"n_vertices":\d+', b'"n_vertices":1073741824', manifest)
    with opened(chromium, SITE, answers | {SITE + "manifest.json": (manifest, kind)}) as found:
        assert "MB of memory: expected at most 3200 MB" in check_advises_another_device(found)


def failing_site(asset: Asset, where: str, message: str) -> dict[str, tuple[bytes, str]]:
    """Return `site` with a RangeError for each DataView of the worker, or of a page that has no worker."""
    begin = f"DataView = class {{ constructor() {{ throw RangeError('{message}'); }} }};\n"
    if where == "loader.js":
        begin += "globalThis.Worker = undefined;\n"
    return site(asset, where, begin)


@pytest.mark.parametrize("where", ["worker.js", "loader.js"])
def test_a_device_that_refuses_memory_is_not_told_that_the_data_are_broken(
    chromium: Browser, asset: Asset, where: str
) -> None:
    """Memory is refused to the worker that decodes, and to the page, which then decodes without one."""
    for message in ("Array buffer allocation failed", "Out of memory"):  # in Chromium, in Safari
        with opened(chromium, SITE, failing_site(asset, where, message)) as found:
            assert message in check_advises_another_device(found)


@pytest.mark.parametrize("where", ["worker.js", "loader.js"])
def test_data_that_end_too_soon_are_not_taken_for_a_lack_of_memory(
    chromium: Browser, asset: Asset, where: str
) -> None:
    message = "Offset is outside the bounds of the DataView"
    with opened(chromium, SITE, failing_site(asset, where, message)) as found:
        found.page.wait_for_selector("body.failed")
        said = found.page.inner_text("#status")
        assert message in said and "load the page again" in said and "memory" not in said


def test_a_page_that_was_cut_short_says_so(chromium: Browser, asset: Asset, tmp_path: Path) -> None:
    whole, path = page(asset), tmp_path / "cut.html"
    poster, viewer = whole.index(b'id="poster"'), whole.index(b'id="viewer"')
    for end in (poster + 1000, viewer, viewer + 20_000, int(len(whole) * 0.6), int(len(whole) * 0.9)):
        path.write_bytes(whole[:end])
        with opened(chromium, path.as_uri()) as found:
            found.page.wait_for_function("() => document.body.innerText.includes('cannot be shown here')")
            said = found.page.inner_text("body")
            assert "cut short" in said and "ask for it anew" in said
            has_poster = "() => document.getElementById('poster')?.naturalWidth > 0"
            assert found.page.evaluate(has_poster) == (end >= viewer)
            told = found.page.evaluate("() => vfr.ready.then(() => null, (error) => error.message)")
            assert "cut short" in told


@pytest.mark.parametrize("where", [b'id="viewer"', b'data-file="part_0.bin">', b'data-file="head.bin">'])
def test_a_page_that_was_changed_says_so(
    chromium: Browser, asset: Asset, tmp_path: Path, where: bytes
) -> None:
    """A page says so if one character of the viewer's script, of the scene, or of the head was changed."""
    changed, path = bytearray(page(asset)), tmp_path / "changed.html"
    at = changed.index(where) + 1000
    changed[at] = ord("a" if changed[at] != ord("a") else "b")
    path.write_bytes(changed)
    with opened(chromium, path.as_uri()) as found:
        found.page.wait_for_function("() => document.body.innerText.includes('cannot be shown here')")
        assert "changed on its way" in found.page.inner_text("body")
        told = found.page.evaluate("() => vfr.render({}).then(() => null, (error) => error.message)")
        assert "changed on its way" in told


def test_a_page_whose_manifest_was_changed_says_so(chromium: Browser, asset: Asset, tmp_path: Path) -> None:
    path = tmp_path / "changed.html"
    path.write_bytes(page(asset).replace(b'"n_channels":4', b'"n_channels":5', 1))
    with opened(chromium, path.as_uri()) as found:
        told = found.page.evaluate("() => vfr.ready.then(() => null, (error) => error.message)")
        assert told == "manifest.json: sha256: expected another one: it was changed on its way"
