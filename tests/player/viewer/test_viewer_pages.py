"""Tests of pages beside the viewer: made once, sent to many at a time, and only to those let in."""

from __future__ import annotations

import hashlib
import http.client
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from player.asset.asset import Asset
from player.errors import ConfigError, FormatError
from player.render import March, Renderer
from player.viewer import pages
from player.viewer.server import ServeSettings, free_port, guarded_server, serve
from tests.player.page.viewer_page import chromium
from tests.player.viewer.viewer_client import SECONDS, Server

BODY = np.random.default_rng(0).bytes(8 << 20)


@contextmanager
def serving(*makers: Callable[[], bytes]) -> Iterator[int]:
    """Run a server with these pages; yield its port."""
    served = pages.Pages(makers)
    server = guarded_server("127.0.0.1", free_port("127.0.0.1", None), "", served)
    try:
        yield server.get_port()
    finally:
        served.close()
        server.stop()


def got(port: int, path: str = "/page", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=SECONDS)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    found = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    connection.close()
    return found


def test_twenty_visitors_get_a_page_that_is_made_once() -> None:
    n_made = []

    def make() -> bytes:
        n_made.append(threading.current_thread())
        time.sleep(0.3)
        return BODY

    with serving(make) as port, ThreadPoolExecutor(20) as pool:
        answers = list(pool.map(lambda _: got(port), range(20)))
    assert len(n_made) == 1
    for status, headers, body in answers:
        assert status == 200 and hashlib.sha256(body).digest() == hashlib.sha256(BODY).digest()
        assert headers["content-type"] == "text/html; charset=utf-8"
        assert headers["content-length"] == str(len(BODY))


def test_slow_visitors_take_no_memory() -> None:
    """Twenty visitors who request 40 MB and read nothing take little memory; naively it would be 800 MB."""

    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

    body = BODY * 5
    with serving(lambda: body) as port:
        before = resident_mb()
        slow = [socket.create_connection(("127.0.0.1", port), SECONDS) for _ in range(20)]
        for connection in slow:
            connection.sendall(f"GET /page HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        assert got(port)[2] == body, "nobody else waits for them"
        assert resident_mb() - before < 200
        slow[0].close()
        with slow[1].makefile("rb") as answer:
            assert answer.read().partition(b"\r\n\r\n")[2] == body, "and they get all of it in the end"
        for connection in slow[1:]:
            connection.close()


def test_whoever_asked_first_may_go() -> None:
    go = threading.Event()

    def make() -> bytes:
        assert go.wait(SECONDS)
        return BODY

    with serving(make) as port:
        first = socket.create_connection(("127.0.0.1", port), SECONDS)
        first.sendall(f"GET /page HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        time.sleep(0.2)
        first.close()
        with ThreadPoolExecutor(1) as pool:
            second = pool.submit(got, port)
            time.sleep(0.2)
            go.set()
            assert second.result()[2] == BODY


def test_the_page_of_each_asset_and_one_that_has_none() -> None:
    def refuse() -> bytes:
        raise ConfigError("scene.html: expected at most 512 MB, got 600")

    with serving(lambda: b"one", lambda: b"two", refuse) as port:
        assert (
            got(port, "/page")[2] == got(port, "/page?x")[2] == b"one" and got(port, "/page/1")[2] == b"two"
        )
        for _ in range(2):
            status, headers, body = got(port, "/page/2")
            assert (status, body) == (503, b"page: scene.html: expected at most 512 MB, got 600\n")
            assert headers["content-type"] == "text/plain; charset=utf-8"
        assert [got(port, path)[0] for path in ("/page/3", "/page/0", "/pages", "/page/")] == [404] * 4
        assert got(port, "/")[0] == 200


@pytest.mark.parametrize("error", [FormatError("part_1.bin: cut short"), MemoryError()], ids=["503", "bug"])
def test_a_page_that_could_not_be_made_is_tried_again(error: Exception) -> None:
    """A page that could not be made, for example while its asset was being copied, is tried again."""
    n_made = []

    def make() -> bytes:
        n_made.append(1)
        if len(n_made) == 1:
            raise error
        return b"page"

    with serving(make) as port:
        if isinstance(error, FormatError):
            assert got(port)[::2] == (503, b"page: part_1.bin: cut short\n")
        else:
            with pytest.raises(ConnectionError):
                got(port)
        assert [got(port)[2] for _ in range(2)] == [b"page"] * 2
    assert len(n_made) == 2


@pytest.mark.parametrize(
    "headers",
    [{"Host": "example.org"}, {"Origin": "http://example.org"}, {"Host": "example.org:80"}],
    ids=str,
)
def test_a_page_is_guarded_as_the_viewer_is(headers: dict[str, str]) -> None:
    n_made: list[int] = []

    def make() -> bytes:
        n_made.append(1)
        return b"page"

    with serving(make) as port:
        status, _, body = got(port, **headers)
        assert status == 403 and b"expected" in body
        assert not n_made
        assert got(port, Origin=f"http://127.0.0.1:{port}")[2] == b"page"


def test_visitors_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "MOST_DOWNLOADS", 2)
    with serving(lambda: BODY) as port:
        slow = [socket.create_connection(("127.0.0.1", port), SECONDS) for _ in range(2)]
        for connection in slow:
            connection.sendall(f"GET /page HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
            assert connection.recv(10) == b"HTTP/1.1 2"
        status, _, body = got(port)
        assert status == 503 and body == b"page: at most 2 visitors at a time: try again\n"
        for connection in slow:
            connection.close()
        end = time.monotonic() + SECONDS
        while got(port)[0] != 200:
            assert time.monotonic() < end
            time.sleep(0.05)


def test_a_server_that_stops_waits_for_nobody() -> None:
    with serving(lambda: BODY) as port:
        slow = socket.create_connection(("127.0.0.1", port), SECONDS)
        slow.sendall(f"GET /page HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        assert slow.recv(10) == b"HTTP/1.1 2"
        begin = time.monotonic()
    assert time.monotonic() - begin < 3
    slow.close()


def test_a_page_is_made_with_the_settings_of_the_viewer(
    asset: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page's first picture is rendered with the viewer's threads and march, within its memory."""
    seen: list[tuple[int | None, March]] = []

    def renderer(asset: Asset, n_threads: int | None = None, march: March = "auto") -> Renderer:
        seen.append((n_threads, march))
        return Renderer(asset, n_threads, march)

    monkeypatch.setattr("player.page.poster.Renderer", renderer)
    with serve(asset, ServeSettings(threads=1, march="numpy")) as address:
        assert got(int(address.rpartition(":")[2]))[0] == 200
    assert seen == [(1, "numpy")]
    with serve(asset, ServeSettings(march="numpy", max_memory=1e-6)) as address:
        status, _, body = got(int(address.rpartition(":")[2]))
    assert status == 503 and b"memory: expected at most 1e-06 GB" in body


def test_the_viewer_has_a_link_to_the_page(shells_folder: Path, tmp_path: Path) -> None:
    """The viewer links to the page, which then plays on the browser's own WebGL."""
    server = Server(tmp_path / "errors.txt", shells_folder)
    with chromium() as browser:
        viewer = browser.new_page()
        viewer.set_default_timeout(SECONDS * 1000)
        viewer.goto(server.address)
        link = viewer.get_by_role("link", name="The same on this device's own GPU")
        address = link.evaluate("link => link.href")
        assert address == f"{server.address}/page"
        page = browser.new_page()
        page.set_default_timeout(SECONDS * 1000)
        said: list[str] = []
        page.on("console", lambda message: said.append(message.text))
        page.goto(address)
        page.wait_for_selector("#canvas[data-shown]")
        assert page.title() == "shells" and not said
        viewer.close()
        page.close()
    assert f"{server.address}/page" in server.errors.read_text()
    assert server.stop() == 130
