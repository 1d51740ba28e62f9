"""Tests of the viewer: its layers, its messages when it cannot open, and its look in a real browser."""

from __future__ import annotations

import io
import shutil
import socket
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.error import URLError

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from player.app import cli
from player.asset.asset import Asset
from player.cameras.transforms import read_cameras
from player.errors import ConfigError
from player.render import Renderer
from player.viewer.layers import LAYERS, layer_picture
from player.viewer.server import ServeSettings, address_for_others, free_port, serve
from tests.player.conftest import write_shells
from tests.player.viewer.viewer_client import SECONDS, Server

WINDOW = {"width": 900, "height": 500}


# --- layers ---


def test_layers_show_what_they_say(asset: Asset) -> None:
    with Renderer(asset, 1) as renderer:
        frame = renderer.render(read_cameras(asset.path("cameras.json"))[0], background=(0.0, 0.0, 1.0))
    pictures = {layer: layer_picture(frame, layer) for layer in LAYERS}
    assert all(picture.shape == (40, 48, 3) and picture.dtype == np.uint8 for picture in pictures.values())
    met = frame.opacity > 0.5
    assert (pictures["colour"] == frame.to_uint8()).all()
    assert (pictures["opacity"][..., 1] == np.floor(frame.opacity * 255 + 0.5)).all()
    decoded = pictures["normals"][met] / 127.5 - 1
    assert np.abs(decoded - frame.normals[met]).max() < 0.01 and not pictures["normals"][~met].any()
    # lightness falls with depth and rises with the number of samples
    light = {name: picture.astype(float) @ [0.2, 0.7, 0.1] for name, picture in pictures.items()}
    assert np.corrcoef(light["depth"][met], frame.depth[met])[0, 1] < -0.9
    assert np.corrcoef(light["samples"].ravel(), frame.n_density_samples.ravel())[0, 1] > 0.9


def test_layers_of_an_empty_picture(asset: Asset) -> None:
    camera = read_cameras(asset.path("cameras.json"))[0]
    far = np.eye(4)
    far[:3, 3] = 1e3
    away = camera.transformed(far)
    with Renderer(asset, 1) as renderer:
        frame = renderer.render(away)
    for layer in LAYERS[1:4]:
        assert not layer_picture(frame, layer).any()


# --- where it cannot open ---


def test_without_viser_it_says_what_to_install_and_how_to_render(
    shells_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main([str(shells_folder)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "pip install 'vfr-bake[viewer]'" in error
    assert f"or render files: vfr-play {shells_folder} --orbit 60 --output frames/" in error


def test_a_port_that_is_taken() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"viewer: --port {port} at 127.0.0.1: expected a free port"):
            free_port("127.0.0.1", port)
    assert 8080 <= free_port("127.0.0.1", None) < 8180


def test_a_host_is_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def unknown(host: str, *_: Any, **__: Any) -> Any:
        asked.append(host)
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    message = "--host: expected an address of this machine, got nowhere.example: Name or service not known"
    with pytest.raises(ConfigError, match=message):
        free_port("nowhere.example", None)
    assert asked == ["nowhere.example"]


def test_an_address_of_another_machine(shells_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An address of another machine is refused at once; the server itself would try ports without end."""
    assert cli.main([str(shells_folder), "--host", "192.0.2.1", "--port", "8080"]) == 1
    assert "--host: expected an address of this machine, got 192.0.2.1: " in capsys.readouterr().err
    assert cli.main([str(shells_folder), "--background", "transparent"]) == 1
    assert "expected a colour for the viewer" in capsys.readouterr().err


def test_visitors_are_told_an_address_that_leads_to_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    here = "http://127.0.0.1:9000"
    monkeypatch.setattr(socket, "gethostname", lambda: "Workstation.example")
    for host in ("0.0.0.0", "::"):
        assert address_for_others(host, here) == "http://workstation.example:9000"
    assert address_for_others("127.0.0.1", here) == here
    assert address_for_others("::1", "http://[::1]:9000") == "http://[::1]:9000"
    monkeypatch.setattr(socket, "gethostname", lambda: "no name of a page")
    assert address_for_others("0.0.0.0", here) == here


def test_a_program_serves_as_the_command_does(asset: Asset, capfd: pytest.CaptureFixture[str]) -> None:
    """`serve` serves one asset or several while its block runs, and prints nothing."""
    for assets in (asset, [asset, asset]):
        with serve(assets, ServeSettings(march="numpy")) as address:
            with urllib.request.urlopen(address) as page:
                assert page.status == 200 and b"<html" in page.read()
        with pytest.raises(URLError):
            urllib.request.urlopen(address)
    assert capfd.readouterr() == ("", "")


# --- in a browser ---


@pytest.fixture(scope="module")
def server(shells_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("viewer") / "errors.txt", shells_folder)
    yield server
    server.stop()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.fail("expected Chromium, got none: make system-libraries installs it")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
               "--disable-background-networking", "--disable-component-update", "--disable-sync"]  # fmt: skip
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=options)
        yield browser
        browser.close()


# Records every size that the viewer states, in order, also those between two looks at the page.
WATCH = """() => {
  const input = [...document.querySelectorAll('input:disabled')].find(i => /^\\d+x\\d+, /.test(i.value));
  window.sizes = [];
  let last = '';
  setInterval(() => {
    if (input.value === last) return;
    last = input.value;
    window.sizes.push(last.split(',')[0].split('x').map(Number));
  }, 5);
}"""


def wait_for(what: Callable[[], object], page: Page) -> None:
    end = time.monotonic() + SECONDS
    while not what():
        assert time.monotonic() < end, "waited in vain"
        page.wait_for_timeout(50)


def opened(browser: Browser, server: Server) -> Page:
    page = browser.new_page(viewport=WINDOW)  # type: ignore[arg-type]
    page.set_default_timeout(SECONDS * 1000)
    page.goto(server.address)
    page.wait_for_function(
        "() => [...document.querySelectorAll('input:disabled')].some(i => /^\\d+x\\d+, /.test(i.value))"
    )
    page.evaluate(WATCH)
    settle(page)
    return page


def sizes(page: Page) -> list[int]:
    """Return the pixels of each picture since the last call. The present one is returned again next time."""
    found = page.evaluate("() => window.sizes.splice(0, window.sizes.length - 1).concat(window.sizes)")
    return [width * height for width, height in found]


def settle(page: Page) -> np.ndarray:
    """Return the part of the page that no control covers, once it has not changed for a second."""
    before, since = shot(page), time.monotonic()
    end = time.monotonic() + SECONDS
    while time.monotonic() - since < 1:
        assert time.monotonic() < end, "the picture never came to rest"
        page.wait_for_timeout(100)
        after = shot(page)
        if np.abs(after - before).max() > 0:
            before, since = after, time.monotonic()
    return before


def shot(page: Page) -> np.ndarray:
    data = page.screenshot(clip={"x": 0, "y": 200, "width": 560, "height": 300})
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


def drag(page: Page, dx: int) -> None:
    page.mouse.move(280, 350)
    page.mouse.down()
    page.mouse.move(280 + dx, 360, steps=12)
    page.mouse.up()


def choose(page: Page, option: str, dropdown: int = 0) -> None:
    page.locator("input.mantine-Select-input:visible").nth(dropdown).click()
    page.get_by_role("option", name=option).click()


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Return the share of the pixels that differ clearly."""
    return float((np.abs(after - before).max(axis=-1) > 24).mean())


def test_a_drag_changes_the_picture_and_standing_still_sharpens_it(browser: Browser, server: Server) -> None:
    page = opened(browser, server)
    before = settle(page)
    whole = sizes(page)[-1]
    assert changed(before, np.full_like(before, 255)) > 0.1, "there is something to see"
    drag(page, 150)
    after = settle(page)
    seen = sizes(page)
    assert changed(before, after) > 0.05
    assert min(seen) < whole / 2, "smaller pictures while it moved"
    # not the same size: viser itself uses fewer pixels of the screen when the browser is slow
    assert seen[-1] > 2 * min(seen) and seen[-1] >= 0.4 * whole, "and a large one in the end"
    with page.expect_download() as download:
        page.get_by_role("button", name="Screenshot").click()
    with Image.open(download.value.path()) as picture:
        scale = WINDOW["width"] / picture.width
        exact = picture.convert("RGB").resize((WINDOW["width"], WINDOW["height"]))
    assert 0.2 < scale < 5
    error = np.abs(np.asarray(exact)[200:, :560].astype(int) - after)
    assert error.mean() < 4, "what is shown is the screenshot, but for JPEG and scaling"
    page.close()


def test_layers_training_views_and_a_recorded_path(browser: Browser, server: Server, asset: Asset) -> None:
    from player.cameras.views import frame_rate, read_views

    page = opened(browser, server)
    colour = settle(page)
    choose(page, "opacity")
    wait_for(lambda: changed(colour, shot(page)) > 0.05, page)
    grey = settle(page)
    assert np.ptp(grey, axis=-1).mean() < 3
    choose(page, "colour")
    views = []
    for number in ("3", "1"):
        field = page.locator("input[inputmode=decimal]").nth(2)  # after fetches and field of view
        field.fill(number)
        field.press("Enter")
        views.append(settle(page))
        page.get_by_role("button", name="Record this view").click()
    assert changed(*views) > 0.05
    save = page.get_by_role("button", name="Save path of 2 views")
    with page.expect_download() as download:
        save.click()
    path = Path(download.value.path())
    path = path.rename(path.with_suffix(".json"))
    cameras = read_views(path)
    trained = read_cameras(asset.path("cameras.json"))
    assert len(cameras) == 61 and frame_rate(path) == 30
    for camera, number in ((cameras[0], 3), (cameras[-1], 1)):
        np.testing.assert_allclose(camera.c2w, trained[number].c2w, atol=1e-3)
        focal = trained[number].fy / trained[number].height
        assert camera.fy / camera.height == pytest.approx(focal, rel=0.01)
    page.close()


def test_two_clients_and_one_that_vanishes(browser: Browser, server: Server) -> None:
    one, two = opened(browser, server), opened(browser, server)
    first = settle(one)
    choose(two, "opacity")
    drag(two, -120)
    second = settle(two)
    assert changed(first, second) > 0.05
    assert changed(first, settle(one)) < 0.01, "each has a camera and controls of its own"
    drag(two, 60)  # it is in the middle of rendering when it goes
    two.goto("about:blank")  # without a closing message
    two.close()
    drag(one, 150)
    assert changed(first, settle(one)) > 0.05
    one.close()
    assert server.process.poll() is None and "Traceback" not in server.errors.read_text()


def test_another_asset_of_the_scene(browser: Browser, shells_folder: Path, tmp_path: Path) -> None:
    server = Server(tmp_path / "errors.txt", shells_folder, write_shells(tmp_path / "other", sign=-1))
    page = opened(browser, server)
    first = settle(page)
    choose(page, "other")
    wait_for(lambda: changed(first, shot(page)) > 0.05, page)
    choose(page, shells_folder.name)
    wait_for(lambda: changed(first, shot(page)) < 0.01, page)
    page.close()
    assert server.stop() == 130


def test_ctrl_c_ends_it(shells_folder: Path, tmp_path: Path) -> None:
    server = Server(tmp_path / "errors.txt", shells_folder)
    assert server.stop() == 130
    assert server.errors.read_text().endswith("vfr-play: interrupted\n")


def test_what_it_prints(server: Server, shells_folder: Path) -> None:
    assert server.line == f"{shells_folder}: look at it at {server.address}\n"
    assert server.address.startswith("http://127.0.0.1:")
    said = server.errors.read_text()
    assert "the viewer runs until Ctrl-C" in said and "no display here" in said
    assert f"vfr-play {shells_folder} --orbit 60 --output frames/" in said
