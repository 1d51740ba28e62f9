"""Tests of the page as it is handed out, opened from a disk: the viewer shows what the player renders."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page

from exporters.cli import main
from exporters.export import export_asset
from exporters.options import ExportOptions
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.views import asset_cameras
from player.errors import ConfigError, FormatError
from player.files.images import to_8_bit
from player.page.gpu_memory import decoding_bytes, feature_bytes
from player.page.notebook import inline
from player.page.page import WebPage, page_of_many_files, page_of_one_file
from player.page.page import page as page_of
from player.page.rest import rest_camera
from player.render import Renderer
from player.viewer.server import ServeSettings, serve
from tests.player.page.viewer_page import SECONDS, wait_for

SIZE = {"width": 300, "height": 245}


@pytest.fixture(scope="module")
def file(asset: Asset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "shells.html"
    path.write_bytes(page_of(asset, "Two shells"))
    return path


@contextmanager
def opened(browser: Browser, file: Path, hash_: str = "", **options: Any) -> Iterator[Page]:
    """Open the page without a network and wait for the scene; check that it requests and logs nothing."""
    context = browser.new_context(viewport=SIZE, offline=True, **options)  # type: ignore[arg-type]
    page = context.new_page()
    page.set_default_timeout(SECONDS * 1000)
    said: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(file.as_uri() + hash_)
    page.wait_for_selector("#canvas[data-shown]")
    yield page
    context.close()
    assert not said
    assert not [url for url in asked if not url.startswith(("blob:", "data:", file.as_uri()))]


def whole(page: Page) -> np.ndarray:
    """Return what the canvas shows, [h, w, 3], when all pictures are accumulated."""
    width, height = page.evaluate("() => [canvas.clientWidth, canvas.clientHeight]")
    page.wait_for_selector(f"#canvas[data-shown='{width}x{height}'][data-done]")
    data = page.screenshot(clip={"x": 0, "y": 0, "width": width, "height": height})
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera for a window of this size, with all of its picture fitted in."""
    scale = min(width / camera.width, height / camera.height)
    return Camera(
        camera.name, camera.c2w, width, height, camera.fx * scale, camera.fy * scale,
        width / 2 + (camera.cx - camera.width / 2) * scale,
        height / 2 + (camera.cy - camera.height / 2) * scale,
    )  # fmt: skip


def rendered(asset: Asset, camera: Camera, shape: tuple[int, ...], background: Any = None) -> np.ndarray:
    """Return the player's picture, [h, w, 3], as the mean of 3 x 3 rays in each pixel."""
    camera = fitted(camera, shape[1], shape[0])
    big = camera.resized(3 * camera.width, 3 * camera.height)
    with Renderer(asset) as renderer:
        rgb = renderer.render(big, background=background).rgb
    return to_8_bit(rgb.reshape(shape[0], 3, shape[1], 3, 3).mean(axis=(1, 3))).astype(int)


def near(one: np.ndarray, two: np.ndarray) -> bool:
    """Return whether two pictures are the same but for how their pixels were averaged (PSNR over 32 dB)."""
    return 10 * math.log10(255**2 / max(np.square(one - two).mean(), 1e-9)) > 32


def test_it_begins_with_the_poster_and_shows_what_the_player_renders(
    chromium: Browser, file: Path, asset: Asset
) -> None:
    rest = rest_camera(asset_cameras(asset))
    with opened(chromium, file, "#turn=off") as page:
        picture = whole(page)
        assert near(picture, rendered(asset, rest, picture.shape))
        assert page.title() == "Two shells" and page.locator("h1").text_content() == "Two shells"
        assert page.locator("#poster").get_attribute("alt") == "Preview of Two shells"
        with page.expect_download() as download:
            page.get_by_role("button", name="Picture as PNG").click()
        with Image.open(Path(download.value.path())) as saved:
            assert saved.size == picture.shape[1::-1]
            assert near(np.asarray(saved.convert("RGB")).astype(int), picture)


def test_a_training_view_of_the_address_and_a_background(chromium: Browser, file: Path, asset: Asset) -> None:
    with opened(chromium, file, "#view=3&noui&background=0,0,255") as page:
        picture = whole(page)
        assert picture.shape[:2] == (SIZE["height"], SIZE["width"])
        assert near(picture, rendered(asset, asset_cameras(asset)[3], picture.shape, (0.0, 0.0, 1.0)))


def test_a_drag_layers_and_a_lost_context(chromium: Browser, file: Path) -> None:
    with opened(chromium, file, "#turn=off") as page:
        colour = whole(page)
        pictures = [colour]
        for layer in ("Depth", "Normals", "Opacity"):
            page.locator("#layer").select_option(label=layer)
            wait_for(page, lambda: not (whole(page) == pictures[-1]).all())
            pictures.append(whole(page))
        assert np.ptp(pictures[3], axis=-1).max() <= 2 and pictures[3].max() > 200
        page.locator("#layer").select_option(label="Colour")
        wait_for(page, lambda: near(whole(page), colour))
        page.mouse.move(150, 100)
        page.mouse.down()
        page.mouse.move(220, 110, steps=6)
        page.mouse.up()
        wait_for(page, lambda: not near(whole(page), colour))
        turned = whole(page)
        page.evaluate(
            """() => {
              const gl = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
              gl.loseContext();
              dispatchEvent(new KeyboardEvent("keydown", { key: "c" })); // does nothing now
              setTimeout(() => gl.restoreContext(), 300);
            }"""
        )
        page.wait_for_function("() => document.getElementById('status').textContent !== ''")
        page.wait_for_function("() => document.getElementById('status').textContent === ''")
        page.evaluate("() => delete canvas.dataset.done")
        assert near(whole(page), turned)


def test_a_double_click_looks_at_what_was_hit(chromium: Browser, file: Path, asset: Asset) -> None:
    with opened(chromium, file, "#turn=off", reduced_motion="reduce") as page:
        picture = whole(page)
        rest = fitted(rest_camera(asset_cameras(asset)), picture.shape[1], picture.shape[0])
        x, y = 110, 70
        assert not (picture[y, x] == 255).all(), "there is something"
        page.mouse.dblclick(x, y)
        wait_for(page, lambda: not near(whole(page), picture))
        aimed = whole(page)
        rays_o, rays_d = rest.rays()
        back = -rays_d[y * rest.width + x]
        right = np.cross([0.0, 0, 1], back)
        right /= np.linalg.norm(right)
        c2w = np.eye(4)
        c2w[:3, :4] = np.stack([right, np.cross(back, right), back, rays_o[0]], axis=-1)
        looking = Camera("", c2w, rest.width, rest.height, rest.fx, rest.fy, rest.width / 2, rest.height / 2)
        assert near(aimed, rendered(asset, looking, picture.shape)), (
            "it looks at that point from where it was"
        )


def test_a_notebook_shows_it_below_a_cell(chromium: Browser, asset: Asset, tmp_path: Path) -> None:
    """A notebook shows the page below a cell, in a frame that can reach nothing of the notebook."""
    shown = inline(asset, height=300)
    notebook = tmp_path / "notebook.html"
    notebook.write_text(f"<!doctype html><title>Notebook</title><h1>Cell</h1>{shown._repr_html_()}")
    context = chromium.new_context(viewport={"width": 400, "height": 400}, offline=True)
    page = context.new_page()
    page.set_default_timeout(SECONDS * 1000)
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.goto(notebook.as_uri())
    frame = page.frames[1]
    frame.wait_for_selector("#canvas[data-shown]")
    assert page.locator("iframe").bounding_box()["height"] == 300  # type: ignore[index]
    assert frame.evaluate(
        "() => { try { return parent.document.title; } catch (error) { return error.name; } }"
    ) == ("SecurityError")
    assert frame.evaluate("() => vfr.ready.then(() => vfr.info.n_channels)") == asset.manifest.n_channels
    assert frame.evaluate("() => vfr.info.quality") in ("high", "fast")
    card = frame.locator("#card")
    frame.locator("#help").click()
    assert card.is_visible()
    frame.locator("#close").click()
    assert not card.is_visible()
    context.close()
    assert not said


@pytest.mark.parametrize("make", [page_of_one_file, page_of_many_files])
def test_a_page_without_javascript_says_what_to_do(
    chromium: Browser, asset: Asset, tmp_path: Path, make: Callable[[Asset], WebPage]
) -> None:
    for name, data in make(asset).files.items():
        (tmp_path / name).write_bytes(data)
    with chromium.new_context(java_script_enabled=False) as context:
        found = context.new_page()
        found.set_default_timeout(SECONDS * 1000)
        found.goto((tmp_path / "index.html").as_uri())
        wait_for(found, lambda: "script cannot run here. Open " in found.inner_text("#status"))
        assert "with JavaScript switched on" in found.inner_text("#status")


@pytest.mark.parametrize(("n_channels", "most"), [(4, 2**24), (32, 2**24), (33, 2**23), (40, 2**23)])
def test_rows_that_no_texture_holds_are_refused(n_channels: int, most: int) -> None:
    """More rows of features are refused than a shader can tell apart (2^24), or than fit into the 256 layers
    of 256 lines that WebGL 2 guarantees."""
    assert feature_bytes(most, n_channels) >= most * n_channels
    with pytest.raises(FormatError, match=f"expected at most {most} rows of features, got {most + 1}"):
        feature_bytes(most + 1, n_channels)


def test_more_graphics_memory_than_may_be_is_refused(asset: Asset, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected at most 1 MB, got \d+ MB: bake it smaller"):
        export_asset(asset.folder, tmp_path / "scene.html", ExportOptions(max_gpu_mb=1))
    assert not list(tmp_path.iterdir())


def test_more_memory_than_browsers_give_a_page_is_refused(
    asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = page_of_one_file.__globals__
    monkeypatch.setitem(limits, "MOST_DECODING_BYTES", decoding_bytes(asset))
    for name in ("scene.html", "site"):
        export_asset(asset.folder, tmp_path / name, ExportOptions(format=None if "." in name else "web"))
    monkeypatch.setitem(limits, "MOST_DECODING_BYTES", decoding_bytes(asset) - 1)
    for make in (page_of_one_file, page_of_many_files):
        with pytest.raises(ConfigError, match=r"memory to unpack the scene: expected at most \d+ MB, which"):
            make(asset)


def test_no_page_but_an_exported_one_is_refused_for_its_graphics_memory(
    asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The viewer and notebooks have no option that would allow more; each visitor's device decides."""
    monkeypatch.setitem(page_of.__globals__, "gpu_bytes", lambda asset: 600_000_000)
    with serve(asset, ServeSettings(march="numpy")) as address, urlopen(f"{address}/page") as answer:
        assert answer.read() == inline(asset).content == page_of(asset)
    with pytest.raises(ConfigError, match=r"expected at most 512 MB, got 600 MB: .* more \(--max-gpu-mb\)"):
        export_asset(asset.folder, tmp_path / "scene.html")


def test_memory_is_told_in_megabytes_that_suffice(
    asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Memory is rounded up: a page that is refused never seems to take what it may take at most, and may be
    exported with the number that is told."""
    for name in ("gpu_bytes", "decoding_bytes"):
        monkeypatch.setitem(page_of.__globals__, name, lambda asset: 47_000_001)
    with pytest.raises(ConfigError, match="graphics memory: expected at most 47 MB, got 48 MB"):
        export_asset(asset.folder, tmp_path / "scene.html", ExportOptions(max_gpu_mb=47))
    assert main([str(asset.folder), str(tmp_path / "scene.html"), "--max-gpu-mb", "48"]) == 0
    assert "48 MB of graphics memory" in capsys.readouterr().out
    monkeypatch.setitem(page_of.__globals__, "MOST_DECODING_BYTES", 47_000_000)
    with pytest.raises(ConfigError, match=r"unpack the scene: expected at most 47 MB, .* got 48 MB"):
        page_of(asset)
