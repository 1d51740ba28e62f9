"""Tests of who is let in to the viewer, and how it treats messages, over real connections."""

from __future__ import annotations

import math
import socket
import struct
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import rich
import viser
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus

from player.asset.asset import Asset
from player.errors import MissingExtraError
from player.render import Renderer
from player.viewer import guard, messages
from player.viewer.guard import MOST_CLIENTS, MOST_SOCKETS, Guard
from player.viewer.messages import colour, one_of, pressed, within
from player.viewer.server import ServeSettings, free_port, guarded_server, serve
from player.viewer.window import MOST_PIXELS, MOST_SIDE
from tests.player.conftest import write_shells
from tests.player.viewer.viewer_client import CAMERA, SECONDS, Client, Server, get, opened, still_serves


@pytest.fixture(scope="module")
def server(shells_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("viewer")
    server = Server(folder / "errors.txt", shells_folder, write_shells(folder / "other", sign=-1))
    yield server
    assert server.stop() == 130
    said = server.errors.read_text()
    assert "Traceback" not in said and "Exception" not in said, said[-3000:]


# --- who is let in ---


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LOCALHOST", "[::1]"])
@pytest.mark.parametrize("port", ["", ":9000"])
def test_this_machine_is_let_in_by_any_forwarded_port(name: str, port: str, server: Server) -> None:
    host = name + port
    assert get(server, {"Host": host})[0] == 200
    assert get(server, {"Host": host, "Origin": f"http://{host}"})[0] == 200


@pytest.mark.parametrize(
    ("headers", "reason"),
    [
        ({"Host": "evil.example"}, "Host: expected 127.0.0.1, localhost, ::1 or the name given with --host"),
        ({"Host": "127.0.0.1.evil.example:8080"}, "Host: expected"),
        ({"Host": "localhost@evil.example"}, "Host: expected"),
        ({"Host": "192.0.2.7:8080"}, "Host: expected"),
        ({"Host": ""}, "Host: expected"),
        ({}, "Host: expected 127.0.0.1, localhost, ::1 or the name given with --host, got none"),
        ({"Host": "localhost", "Origin": "http://evil.example"}, "Origin: expected http://localhost, got"),
        ({"Host": "localhost", "Origin": "https://localhost"}, "Origin: expected http://localhost, got"),
        ({"Host": "localhost", "Origin": "http://localhost:3000"}, "Origin: expected http://localhost, got"),
        ({"Host": "localhost", "Origin": "null"}, "Origin: expected http://localhost, got 'null'"),
        ({"Host": "localhost", "Upgrade": "WebSocket"}, "Upgrade: expected websocket, got 'WebSocket'"),
    ],
)
def test_others_are_refused_in_one_line(headers: dict[str, str], reason: str, server: Server) -> None:
    status, text = get(server, headers)
    assert status == 403 and text.count("\n") == 1 and reason in text


def test_headers_that_come_twice_are_refused() -> None:
    mine = Headers([("Host", "localhost"), ("Host", "evil.example")])
    assert Guard("127.0.0.1", "1.1.1").refusal("/", mine) is not None
    mine = Headers([("Host", "localhost"), ("Origin", "http://localhost"), ("Origin", "http://evil.example")])
    assert Guard("127.0.0.1", "1.1.1").refusal("/", mine) == (403, "Origin: expected one, got several")


@pytest.mark.parametrize(
    "path",
    ["/C:/Windows/win.ini", "/../x", "/a/../x", "/%2e%2e/x", "//x/y", "/a\\b", "/.hidden", "/a:b", "x"],
)
def test_only_names_of_the_page_are_looked_up(path: str, server: Server) -> None:
    assert get(server, {"Host": "localhost"}, path)[0] == 404


@pytest.mark.parametrize(
    "options",
    [
        {"origin": None},
        {"origin": "http://evil.example"},
        {"origin": "https://localhost"},
        {"host": "evil.example", "origin": ""},
        {"subprotocols": None},
        {"subprotocols": ["viser-v0.0.0", "viser-v0*markup*"]},
    ],
)
def test_a_websocket_of_another_page_is_refused(options: dict[str, Any], server: Server) -> None:
    with pytest.raises(InvalidStatus) as caught:
        opened(server, **options)
    assert caught.value.response.status_code == 403


def test_a_websocket_of_this_page_is_let_in_through_a_tunnel(server: Server) -> None:
    with Client(server, host="localhost:4321") as client:
        client.move()
        client.picture()


def test_which_names_an_address_answers_to() -> None:
    """A viewer that others may open answers to any IP address, but only to this machine's own names."""
    for host in ("0.0.0.0", "::", "192.0.2.1"):
        guard = Guard(host, "1.1.1")
        own = socket.gethostname().lower()
        for name in ("localhost", "192.0.2.1", "2001:db8::1", own, f"{own}.local"):
            assert guard.answers_to(name), (host, name)
        assert not guard.answers_to("evil.example") and not guard.answers_to("evil.local")
        status, reason = guard.refusal("/", Headers([("Host", "evil.example")])) or (0, "")
        assert status == 403 and "a numeric address or this machine's own name" in reason
    assert Guard("Workstation", "1.1.1").answers_to("workstation")
    assert not Guard("127.0.0.1", "1.1.1").answers_to("192.0.2.1")


def test_a_viser_that_cannot_be_guarded_serves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port("127.0.0.1", None)
    original = guard.websockets_server.serve
    with monkeypatch.context() as patched:  # a viser that imported `serve` earlier
        patched.setattr(viser.infra._infra.websockets.asyncio, "server", type("", (), {"serve": original}))
        with pytest.raises(MissingExtraError, match=r"a viser whose connections can be checked"):
            guarded_server("127.0.0.1", port)
    assert guard.websockets_server.serve is original
    assert free_port("127.0.0.1", port) == port
    with monkeypatch.context() as patched:  # a viser with other messages
        patched.setattr(guard, "CAMERA_FIELDS", (*messages.CAMERA_FIELDS, "roll"))
        with pytest.raises(MissingExtraError, match=r"pip install viser==1\.1\.1"):
            guarded_server("127.0.0.1", port)


def test_the_output_and_the_warnings_of_a_program_stay_its_own(
    asset: Asset, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """What the program prints while viser starts or stops is printed, as another thread may print then."""

    class Printing(viser.ViserServer):
        def __init__(self, **options: Any) -> None:
            super().__init__(**options)
            sys.stdout.write("started, ")

        def stop(self) -> None:
            super().stop()
            rich.print("stopped")

    monkeypatch.setattr("viser.ViserServer", Printing)
    with serve(asset, ServeSettings(march="numpy")):
        warnings.filterwarnings("ignore", "of the program")
    assert capfd.readouterr() == ("started, stopped\n", "")
    assert any(message and message.match("of the program") for _, message, *_ in warnings.filters)


def test_a_client_cannot_open_a_way_in_from_the_internet(server: Server) -> None:
    """A client cannot open a tunnel, which would be announced on the terminal and to the client. The messages
    that ask for it are not passed on."""
    for kind in ("ShareUrlRequest", "ShareUrlDisconnect"):
        assert messages.cleaned(msgspec.msgpack.encode({"type": kind}), {}) is None
    with Client(server) as client:
        client.move()
        client.picture()
        client.send({"type": "ShareUrlRequest"})
        client.send({"type": "ShareUrlDisconnect"})
        assert not any(message["type"].startswith("Share") for message in client.messages(3))


# --- what it is told ---


def test_a_window_of_any_size_has_a_bounded_picture(server: Server) -> None:
    before = server.resident_mb()
    clients = [Client(server) for _ in range(4)]
    windows = [(30_000, 30_000), (1 << 20, 1), (1, 1 << 20), (0, 0)]
    pictures = [(2880, 2880), (MOST_SIDE, 1), (1, MOST_SIDE), (1, 1)]
    for client, (width, height) in zip(clients, windows, strict=True):
        client.move(image_width=width, image_height=height)
    for client, picture in zip(clients, pictures, strict=True):
        sizes = client.sizes(lambda *size, picture=picture: size == picture)
        assert all(width * height <= MOST_PIXELS for width, height in sizes)
        client.socket.close()
    assert server.resident_mb() - before < 1000


NAN, INF = math.nan, math.inf
BAD_CAMERAS: list[dict[str, Any]] = [
    *({"fov": value} for value in (0.0, -1.0, NAN, INF, 3.2, 1e300, "wide", None, [1.0])),
    *({"position": [value, 0.0, 0.0]} for value in (NAN, INF, -INF, 1e300, "x", None)),
    {"position": [0.0, 0.0]},
    {"position": [0.0] * 300},
    *({"wxyz": value} for value in ([0.0] * 4, [NAN] * 4, [2.0, 0, 0, 0], [1.0, 0, 0], "wxyz")),
    {"look_at": CAMERA["position"]},
    {"look_at": [NAN, 0.0, 0.0]},
    {"up_direction": [0.0, 0.0, 0.0]},
    {"up_direction": [INF, 0.0, 0.0]},
    *({"near": value} for value in (NAN, INF, "near")),
    *({"image_width": value} for value in (-1, 1 << 21, 1 << 63, NAN, "8", 8.5)),
    {"roll": 1.0},
    {"type": "RunJavascriptMessage"},
    {"type": 7},
]


@pytest.mark.parametrize("changes", BAD_CAMERAS, ids=str)
def test_a_camera_that_is_none_is_not_passed_on(changes: dict[str, Any]) -> None:
    assert messages.cleaned(msgspec.msgpack.encode(CAMERA), {}) is not None
    assert messages.cleaned(msgspec.msgpack.encode(CAMERA | changes), {}) is None


BAD_VALUES = [NAN, INF, -INF, -5, 1e300, 1 << 63, "x", "9" * 1000, None, [], [1, 2], [NAN] * 3, {}, True]


@pytest.mark.parametrize(
    ("check", "taken"),
    [
        (within(lambda: (0, 16), whole=True), [16, 0, 0, 16, 16]),
        (one_of(("colour", "opacity")), []),
        (colour, []),
        (pressed, [True]),
    ],
    ids=["number", "choice", "colour", "button"],
)
def test_a_control_is_passed_only_what_it_takes(check: Any, taken: list[Any]) -> None:
    """Numbers out of range are passed as the nearest that is in it; everything else that does not fit is
    dropped."""
    sent = [{"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": value}} for value in BAD_VALUES]
    passed = [messages.cleaned(msgspec.msgpack.encode(one), {"a": check}) for one in sent]
    assert [msgspec.msgpack.decode(one[1])["updates"]["value"] for one in passed if one] == taken


def test_controls_begin_as_the_command_line_says(shells_folder: Path, tmp_path: Path) -> None:
    options = ["--samples", "3", "--quality", "high", "--background", "10,200,30", "--march", "numpy"]
    server = Server(tmp_path / "errors.txt", shells_folder, *options)
    with Client(server) as client:
        client.move()
        found = {
            message["props"]["label"]: message["value"]
            for message in client.messages(3)
            if "value" in message and "label" in message.get("props", {})
        }
    assert server.stop() == 130
    assert [found[name] for name in ("Fetches", "Quality", "Background")] == [3, "high", [10, 200, 30]]


def test_the_viewer_renders_as_it_was_told(shells_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[Any, ...]] = []

    def made(*given: Any) -> Renderer:
        seen.append(given[1:])
        return Renderer(*given)

    monkeypatch.setattr("player.viewer.server.Renderer", made)
    with serve(Asset.open(shells_folder), ServeSettings(threads=1, march="numpy")):
        pass
    assert seen == [(1, "numpy")]


@pytest.mark.parametrize("first", [True, False])
def test_a_camera_that_is_none_is_ignored(first: bool, server: Server) -> None:
    """An invalid camera is ignored, whether it is a client's first or a later one; the next one is used."""
    with Client(server) as client:
        if not first:
            client.move()
            client.picture()
        for changes in BAD_CAMERAS:
            client.move(**changes)
        client.send({key: value for key, value in CAMERA.items() if key != "fov"})
        time.sleep(1.0)
        client.move(position=[8.0, 2.5, 3.0], image_width=90)
        client.sizes(lambda *size: size == (90, 60))


def test_controls_take_what_they_offer_alone(server: Server) -> None:
    with Client(server) as client:
        client.move()
        client.picture()
        list(client.messages(1))
        for label in client.controls:
            for value in BAD_VALUES:
                client.set(label, value)
            for name in ("update_cb", "removed", "sync_cb", "props", "uuid", "gui_api", "x"):
                client.send(
                    {"type": "GuiUpdateMessage", "uuid": client.controls[label], "updates": {name: []}}
                )
        client.set("Show", "opacity")
        client.set("Show", "../../etc/passwd")
        client.set("Asset", "other")
        client.set("Asset", "/etc")
        client.set("Fetches", 3)
        list(client.messages(3))
        client.move(image_width=90)
        client.sizes(lambda *size: size == (90, 60))


def test_a_flood_of_cameras_ends_with_the_newest(server: Server) -> None:
    with Client(server) as client:
        client.move()
        client.picture()
        for step in range(600):
            client.move(position=[9.0 - step / 1000, 2.0, 3.0], image_width=80 + step % 2)
        client.move(image_width=77)
        client.sizes(lambda *size: size == (77, 60))


def test_of_many_clicks_one_screenshot_at_a_time(server: Server) -> None:
    """Screenshots are made one at a time: a client that clicks and never reads makes nothing pile up."""
    with Client(server) as client:
        client.move(image_width=800, image_height=800)
        client.picture()
        for _ in range(300):
            client.set("Screenshot", True)
        kind = "FileTransferStartDownload"
        assert any(message["type"] == kind for message in client.messages())
        assert sum(message["type"] == kind for message in client.messages(3)) < 30


def test_messages_that_are_none(server: Server) -> None:
    whole = msgspec.msgpack.encode(CAMERA)
    with Client(server) as client:
        for data in (
            b"",
            b"\xc1",
            whole[:-3],
            whole + whole,
            b"\x81" * 4000,
            b"\x91" * 4000,
            b"\xdd\xff\xff\xff\xff",
        ):
            client.socket.send(data)
        client.socket.send("text")
        client.socket.send([whole[:100], whole[100:]])  # in fragments
        client.picture()
    still_serves(server)


@pytest.mark.parametrize("what", ["long", "fragments", "pings", "bomb", "not a frame"])
def test_a_client_that_overdoes_it_is_dropped(what: str, server: Server) -> None:
    """A client that sends too much, or no frames, as no browser does, is dropped."""
    with Client(server) as client:
        client.move()
        client.picture()
        raw = client.socket.socket
        mask = b"\0" * 4
        if what == "long":
            client.socket.send(b"x" * 5000)
        elif what == "fragments":
            raw.sendall(b"\x02\x80" + mask + (b"\x00\x80" + mask) * 200)
        elif what == "pings":
            raw.sendall((b"\x89\x80" + mask) * 200)
        elif what == "bomb":  # marked as compressed, which the server does not support
            raw.sendall(b"\xc2\xfe" + struct.pack(">H", 1000) + mask + b"\0" * 1000)
        else:
            raw.sendall(bytes(range(256)) * 4)
        end = time.monotonic() + SECONDS
        with pytest.raises(ConnectionClosed):
            while time.monotonic() < end:
                client.socket.recv(SECONDS)
    still_serves(server)


def test_hundreds_of_clients(server: Server) -> None:
    """Clients over the limit are refused with a message; when the others are gone, there is room again."""
    inside: list[Client] = []
    refused = 0
    for _ in range(200):
        try:
            inside.append(Client(server))
        except InvalidStatus as error:
            refused += 1
            assert error.response.status_code == 503 and b"close one" in (error.response.body or b"")
    assert len(inside) == MOST_CLIENTS and refused == 200 - MOST_CLIENTS
    for client in inside:
        client.socket.socket.close()  # without a closing message
    _still_serves_soon(server)


def test_half_open_connections(server: Server) -> None:
    """Connections that send nothing or half a request are limited in number, and closed after some time."""
    sockets = []
    for index in range(2 * MOST_SOCKETS):
        half = socket.create_connection(("127.0.0.1", server.port), SECONDS)
        if index % 2:
            half.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
        sockets.append(half)
    dropped = 0
    for half in sockets:
        half.settimeout(SECONDS)
        try:
            dropped += half.recv(100) == b""
        except ConnectionError:
            dropped += 1
        half.close()
    assert dropped == len(sockets), "each is closed by the server"
    _still_serves_soon(server)


def _still_serves_soon(server: Server) -> None:
    end = time.monotonic() + SECONDS
    while True:
        try:
            return still_serves(server)
        except (InvalidStatus, OSError):
            assert time.monotonic() < end, "no room"
            time.sleep(0.2)
