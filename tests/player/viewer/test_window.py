"""Tests of a window of the viewer without a client: its sizes, its camera, its pictures and its files."""

from __future__ import annotations

import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.rotations import OPENGL_FROM_OPENCV, quaternion
from player.cameras.transforms import read_cameras
from player.march.bounds import BLOCK
from player.march.normals import composited_normals
from player.render import Renderer
from player.viewer import window as window_module
from player.viewer.resolution import FRAME_SECONDS, LEAST, SHARE, SHARP_SECONDS, STILL_SECONDS, Pace, fitted
from player.viewer.window import FIRST_DISTANCE, ViserFrame, Window

# --- sizes ---


@pytest.mark.parametrize("rate", [2e4, 1e6, 1e9])
def test_pace_finds_the_size_that_the_time_allows(rate: float) -> None:
    """The pace finds the right size on a machine of `rate` pixels a second plus 5 ms per picture."""
    pace = Pace()
    for _ in range(40):
        width, height = pace.moving(1000, 800)
        pace.measured(width * height, 0.005 + width * height / rate)
    n = np.prod(pace.moving(1000, 800))
    wanted = (SHARE * FRAME_SECONDS - 0.005) * rate
    assert n == pytest.approx(np.clip(wanted, LEAST, 800_000), rel=0.05)
    assert np.prod(pace.sharp(1000, 800)) >= n


def test_one_hiccup_halves_the_picture_at_most() -> None:
    pace = Pace()
    before = np.prod(pace.moving(1000, 1000))
    pace.measured(int(before), 10.0)
    assert np.prod(pace.moving(1000, 1000)) > before * 0.45
    for _ in range(20):
        pace.measured(int(before), 10.0)
    assert np.prod(pace.moving(1000, 1000)) == pytest.approx(LEAST, rel=0.05)


@pytest.mark.parametrize("rate", [6e4, 1e6, 1e9])
def test_the_sharp_picture_is_there_within_a_second(rate: float) -> None:
    """The sharp picture of any window is there within a second after the camera has stopped, on a machine
    that renders LEAST pixels in the time that a picture may take."""
    pace = Pace()
    for size in ((1000, 800), (3000, 2000), (70, 50)):
        for _ in range(40):
            width, height = pace.moving(*size)
            pace.measured(width * height, 0.005 + width * height / rate)
        width, height = pace.sharp(*size)
        assert STILL_SECONDS + 0.005 + width * height / rate < 1
        assert width * height >= min(0.9 * (SHARP_SECONDS - 0.1) * rate, size[0] * size[1]), (
            "no smaller either"
        )


def test_a_window_of_one_pixel_and_a_flat_one() -> None:
    assert fitted(1, 1, 0.0) == (1, 1) and fitted(3000, 2, 600) == (949, 1)


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e5])
def test_scenes_of_every_size_have_the_same_size_for_viser(size: float, asset: Asset) -> None:
    camera = read_cameras(asset.path("cameras.json"))[0]
    c2w, focus = camera.c2w.copy(), size * np.array([1.0, 2.0, 3.0])
    c2w[:3, 3] = place = size * c2w[:3, 3]
    frame = ViserFrame.around(focus, replace(camera, c2w=c2w))
    seen = frame.from_world(place)
    assert np.linalg.norm(seen) == pytest.approx(FIRST_DISTANCE) and not frame.from_world(focus).any()
    window: Any = Window.__new__(Window)
    window._viser = frame
    handle = SimpleNamespace(
        wxyz=quaternion((c2w @ OPENGL_FROM_OPENCV)[:3, :3]),
        position=seen, image_width=40, image_height=30, fov=0.8,
    )  # fmt: skip
    window._client = SimpleNamespace(camera=handle)
    np.testing.assert_allclose(window._camera().c2w, c2w, rtol=1e-9, atol=1e-9 * size)


def test_a_view_that_stands_at_the_focus() -> None:
    camera = Camera("", np.eye(4), 4, 3, 2.0, 2.0, 2.0, 1.5)
    assert ViserFrame.around(np.zeros(3), camera).unit == 1.0


# --- windows without a client ---


def window_of(renderer: Renderer, camera: Camera, layer: str, sent: list[str]) -> Window:
    """Return a window whose camera stands still; the names of the files that it sends are added to `sent`."""
    window: Any = Window.__new__(Window)
    window._renderer, window._pace, window._camera = renderer, Pace(), lambda: camera
    window._version, window._closed, window._changed = 0, False, threading.Condition()
    window._whole, window._saving = threading.Lock(), threading.Lock()
    window._connection = SimpleNamespace(n_sending=0)
    window._client = SimpleNamespace(
        scene=SimpleNamespace(set_background_image=lambda picture, **_: None),
        send_file_download=lambda name, content, **_: sent.append(name),
    )
    white = (255, 255, 255)
    values = {"layer": layer, "samples": 5, "quality": "exact", "background": white, "state": ""}
    vars(window).update({f"_{name}": SimpleNamespace(value=value) for name, value in values.items()})
    return window


def test_normals_are_rendered_as_other_layers_are(asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    """The renderer's threads compute normals, strip by strip, and they are given up if something changes."""
    camera, names, sent = read_cameras(asset.path("cameras.json"))[0].resized(96, 80), [], []
    monkeypatch.setattr(window_module, "STRIP_PIXELS", camera.width * BLOCK)
    with Renderer(asset, 2, "numpy") as renderer:
        window = window_of(renderer, camera, "normals", sent)
        window._pace._pixels = 1.0

        def change(*arguments: Any) -> np.ndarray:
            names.append(threading.current_thread().name)
            window.touch()
            return composited_normals(*arguments)

        monkeypatch.setattr("player.render.composited_normals", change)
        assert window._in_strips(camera, 0) is None
        monkeypatch.setattr(window, "touch", lambda: None)  # nothing changes any more
        for render in (
            window._show_moving,
            window._screenshot,
            lambda: window._in_strips(camera, window._version),
        ):
            n_before = len(names)
            render()
            assert len(names) > n_before
    assert all(name.startswith("vfr-play") for name in names) and sent == ["screenshot.png"]


@pytest.mark.parametrize(("moving", "n_strips"), [(1.0, 10), (2304.0, 4), (1e9, 1)])
def test_a_strip_has_as_many_pixels_as_a_picture_while_moving(
    moving: float, n_strips: int, asset: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera, heights = read_cameras(asset.path("cameras.json"))[0].resized(96, 80), []
    monkeypatch.setattr(window_module, "STRIP_PIXELS", camera.width * BLOCK)
    with Renderer(asset, 1, "numpy") as renderer:
        window = window_of(renderer, camera, "colour", [])
        window._pace._pixels = moving
        frame = window._frame
        monkeypatch.setattr(window, "_frame", lambda *given: heights.append(given[0].height) or frame(*given))
        assert window._in_strips(camera, 0) is not None
    assert len(heights) == n_strips and sum(heights) == camera.height


def test_a_closed_window_says_nothing_of_its_renderer(asset: Asset) -> None:
    camera = read_cameras(asset.path("cameras.json"))[0]
    with Renderer(asset, 1, "numpy") as renderer:
        window: Any = window_of(renderer, camera, "colour", [])

    def closing() -> Camera:
        window._closed = True
        return camera

    window._camera = closing
    window._run()
    assert window._state.value == ""


@pytest.mark.parametrize("closed", [False, True])
def test_a_picture_that_ends_with_its_window_is_no_bug(
    closed: bool, asset: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C closes windows and then renderers, also in the middle of a picture, which then fails. The same
    error in a window that is open is a bug, and is reported."""
    camera, reported, sent = read_cameras(asset.path("cameras.json"))[0], [], []
    with Renderer(asset, 1, "numpy") as renderer:
        window = window_of(renderer, camera, "colour", sent)
    monkeypatch.setattr(renderer, "_closed", False)  # as if it had been closed in the middle

    def interrupted() -> Camera:
        window._closed = closed
        return camera

    def report(arguments: Any) -> None:
        reported.append(arguments.exc_type)
        window.close()

    monkeypatch.setattr(window, "_camera", interrupted)
    monkeypatch.setattr(threading, "excepthook", report)
    window._run()
    assert reported == ([] if closed else [RuntimeError])
    window._closed = False
    if closed:
        window._screenshot()
    else:
        with pytest.raises(RuntimeError):
            window._screenshot()
    assert not sent
