"""Checks of who may connect to the viewer, and limits on what a client may send.

Any page that is open in a browser can send requests to an address of this machine. If it makes a name of its
own point here (DNS rebinding), it can even read the answers. A browser tells in the header Host which name it
was given, and in Origin which page asks: both are checked before anything else happens. What comes in after
that is limited in length, number and rate, and read by `player.viewer.messages`.

viser has no setting for any of this. It calls `websockets.asyncio.server.serve`, so the checks are inserted
there while viser starts. If a version of viser does not call that, nothing is served.
"""

from __future__ import annotations

import asyncio
import dataclasses
import ipaddress
import logging
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.frames import Frame, Opcode
from websockets.http11 import Request, Response

from player.errors import MissingExtraError
from player.viewer.messages import CAMERA_FIELDS, MAX_BYTES, UPDATE_FIELDS, Check, cleaned
from player.viewer.pages import NO_PAGES, PAGE_SECONDS, Pages

MOST_CLIENTS = 24
MOST_SOCKETS = 128
"""Most open connections, including those that have not sent a request yet."""
CAMERA_SECONDS = 1 / 60
"""Least time in seconds between two moves of a camera that are passed on; of the messages in between, only
the newest counts."""
RATE = 200.0
"""Messages of one client that are read per second; a window whose view is being dragged sends 50."""
OPEN_SECONDS = 10.0
"""Seconds within which a client must send its request, and within which it must take the answer unless that
is a page."""
FIRST_SECONDS = 60.0
"""Seconds after which a client that has not sent its camera is dropped."""
MOST_FRAGMENTS = 16
"""Most fragments that a message may come in."""
MOST_PINGS = 20
"""Most pings of a connection within PING_SECONDS; browsers send none."""
PING_SECONDS = 20.0
MOST_UNREAD_BYTES = 64 << 20
"""Most bytes of answers that a client may leave unread."""

LOOPBACK = ("127.0.0.1", "localhost", "::1")

CONNECTION: ContextVar[GuardedConnection] = ContextVar("CONNECTION")
"""The connection whose message is being handled."""


class Guard:
    """The rules of one server, and its open connections."""

    def __init__(self, host: str, version: str, pages: Pages = NO_PAGES) -> None:
        """`host`: the address to serve at. `version`: viser's version, which its pages must have as well.
        `pages`: the assets' pages, which are served beside the viewer's."""
        self._host = host.lower()
        self.version = version
        self.pages = pages
        self.sockets: set[GuardedConnection] = set()
        self.clients: set[GuardedConnection] = set()
        self.installed = False

    def serve_options(self, answer: Callable[..., Any]) -> dict[str, Any]:
        """Return settings for `websockets.asyncio.server.serve`; `answer` answers the requests that are let
        in."""

        def admit(connection: GuardedConnection, request: Request) -> Any:
            refused = self.refusal(request.path, request.headers)
            if refused is None and "Upgrade" in request.headers:
                if len(self.clients) >= MOST_CLIENTS:
                    refused = 503, f"viewer: expected at most {MOST_CLIENTS} windows: close one"
                else:
                    self.clients.add(connection)
            if refused is None:
                return answer(connection, request)
            response: Response = connection.respond(refused[0], refused[1] + "\n")
            return response

        return {
            "process_request": admit,
            "create_connection": lambda *args, **kwargs: GuardedConnection(self, *args, **kwargs),
            "max_size": MAX_BYTES,
            "compression": None,
            "open_timeout": PAGE_SECONDS,  # for pages; GuardedConnection waits less long for all else
            "logger": _logger(),
        }

    def refusal(self, path: str, headers: Headers) -> tuple[int, str] | None:
        """Return the status and the reason with which a request is refused; None if it is let in."""
        host = _only(headers, "Host")
        name = None if host is None else _name(host)
        if host is None or name is None or not self.answers_to(name):
            return 403, f"Host: expected {', '.join(LOOPBACK)}{self._others()}, got {_quoted(host)}"
        upgrade = headers.get_all("Upgrade")
        origin = _only(headers, "Origin")
        if origin is not None and origin.lower() != f"http://{host}".lower():
            return 403, f"Origin: expected http://{host}, got {_quoted(origin)}"
        if not upgrade:
            if headers.get_all("Origin") and origin is None:
                return 403, "Origin: expected one, got several"
            if not re.fullmatch(r"/(?:[\w-][\w.-]*(?:/[\w-][\w.-]*)*)?(?:\?.*)?", path):
                return 404, "expected the address that vfr-play has printed"
            return None
        if upgrade != ["websocket"]:
            return 403, f"Upgrade: expected websocket, got {_quoted(', '.join(upgrade))}"
        if origin is None:
            return 403, f"Origin: expected http://{host}, got none"
        if _only(headers, "Sec-WebSocket-Protocol") != f"viser-v{self.version}":
            return 403, f"expected a page of viser {self.version}: load it again"
        return None

    def answers_to(self, name: str) -> bool:
        """Return whether a request for the host `name` is meant for this server.

        A foreign page can make a name of its own point here, but not an address. So where other machines may
        connect, any address is accepted, as is the name of this machine, and this name with `.local`, by
        which phones of the same network find it.
        """
        if name in (*LOOPBACK, self._host):
            return True
        own = socket.gethostname().lower()
        return self._host not in LOOPBACK and (_is_address(name) or name in (own, f"{own}.local"))

    def _others(self) -> str:
        """Return in words which other hosts are accepted."""
        if self._host in LOOPBACK:
            return " or the name given with --host"
        return ", the name given with --host, a numeric address or this machine's own name"


class GuardedConnection(ServerConnection):
    """A connection that passes on only checked messages, and not too many of them."""

    def __init__(self, guard: Guard, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._guard = guard
        self.controls: dict[str, Check] = {}
        """The checks of the values that the client sends, by the names of its controls in messages."""
        self.n_sending = 0
        """Messages that are on their way to the client."""
        self._ready: list[bytes] = []
        self._camera: bytes | None = None
        self._camera_due = 0.0
        self._first_due: float | None = None
        self._read_at, self._may_read = 0.0, RATE
        self._n_fragments = self._n_pings = 0
        self._pings_since = 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._guard.sockets.add(self)
        if len(self._guard.sockets) > MOST_SOCKETS:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._guard.sockets.discard(self)
        self._guard.clients.discard(self)
        super().connection_lost(exc)

    async def handshake(self, *args: Any, **kwargs: Any) -> None:
        """Answer the connection's first request: an asset's page is sent here, all else is answered by
        websockets."""
        waited = (self.request_rcvd, self.connection_lost_waiter)
        await asyncio.wait(waited, timeout=OPEN_SECONDS, return_when=asyncio.FIRST_COMPLETED)
        request, guard = self.request, self._guard
        if request is None:
            raise ConnectionError("expected a request")
        if request.path in guard.pages and "Upgrade" not in request.headers:
            if guard.refusal(request.path, request.headers) is None:
                return await guard.pages.send(self, request.path)
        await asyncio.wait_for(super().handshake(*args, **kwargs), OPEN_SECONDS)

    def process_event(self, event: Any) -> None:
        if isinstance(event, Frame):
            if event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._n_fragments = 0 if event.fin else self._n_fragments + 1
            elif event.opcode is Opcode.PING:
                if self.loop.time() - self._pings_since > PING_SECONDS:
                    self._pings_since, self._n_pings = self.loop.time(), 0
                self._n_pings += 1
            unread = self.transport.get_write_buffer_size()
            if self._n_fragments > MOST_FRAGMENTS or self._n_pings > MOST_PINGS or unread > MOST_UNREAD_BYTES:
                self.transport.abort()
                return
        super().process_event(event)

    async def send(self, *args: Any, **kwargs: Any) -> None:
        self.n_sending += 1
        try:
            await super().send(*args, **kwargs)
        finally:
            self.n_sending -= 1

    async def recv(self, decode: bool | None = None) -> Any:
        """Wait for the next message that passes its check; returns it encoded anew.

        Of messages about the camera, only the newest is returned, no sooner than CAMERA_SECONDS after the one
        before.
        """
        CONNECTION.set(self)
        now = self.loop.time
        if self._first_due is None:
            self._first_due = now() + FIRST_SECONDS
        while True:
            if self._ready:
                return self._ready.pop(0)
            if self._camera is not None and now() >= self._camera_due:
                return self._newest_camera(now())
            due = self._first_due if self._camera is None else self._camera_due
            try:
                raw = await asyncio.wait_for(super().recv(), None if due == float("inf") else due - now())
            except (TimeoutError, asyncio.TimeoutError):
                if self._camera is None:
                    await self.close(1008, "expected a camera")
                    self._first_due = float("inf")
                continue
            await self._pause(now())
            message = cleaned(raw, self.controls)
            if message is None:
                continue
            is_camera, data = message
            if is_camera:
                self._camera, self._first_due = data, float("inf")
                continue
            if self._camera is not None:  # a pressed control refers to the newest view
                self._ready.append(self._newest_camera(now()))
            self._ready.append(data)

    def _newest_camera(self, now: float) -> bytes:
        data, self._camera = self._camera, None
        assert data is not None
        self._camera_due = now + CAMERA_SECONDS
        return data

    async def _pause(self, now: float) -> None:
        """Wait until the next message may be read; meanwhile messages pile up on the client's side."""
        self._may_read = min(self._may_read + (now - self._read_at) * RATE, RATE) - 1
        self._read_at = now
        if self._may_read < 0:
            await asyncio.sleep(-self._may_read / RATE)


@contextmanager
def every_connection_checked(guard: Guard) -> Iterator[None]:
    """Make every connection to a viser server that starts in the `with` block a GuardedConnection. Raises
    MissingExtraError if this version of viser does not allow that."""
    from viser import _gui_handles, _messages

    wanted = {
        _messages.ViewerCameraMessage: CAMERA_FIELDS,
        _messages.GuiUpdateMessage: UPDATE_FIELDS,
    }
    known = all(
        {field.name for field in dataclasses.fields(kind)} == {*fields} for kind, fields in wanted.items()
    )
    known = known and "uuid" in {field.name for field in dataclasses.fields(_gui_handles._GuiHandleState)}
    if not known:
        raise _unknown_viser(guard.version)
    original = websockets_server.serve

    def serve(handler: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        guard.installed = True
        return original(handler, *args, **{**kwargs, **guard.serve_options(kwargs["process_request"])})

    websockets_server.serve = serve
    try:
        yield
    finally:
        websockets_server.serve = original
    if not guard.installed:
        raise _unknown_viser(guard.version)


def _unknown_viser(version: str) -> MissingExtraError:
    return MissingExtraError(
        "viewer: expected a viser whose connections can be checked, such as 1.1.1, got "
        f"{version}: pip install viser==1.1.1"
    )


def _logger() -> logging.Logger:
    """Return a logger for websockets' server that drops the messages which any client can cause."""
    logger = logging.getLogger("websockets.server.vfr-play")
    logger.addFilter(
        lambda record: not record.getMessage().startswith(("opening handshake failed", "connection rej"))
    )
    return logger


def own_name() -> str | None:
    """Return this machine's name, in lower case; None if no browser could ask for it."""
    return _name(socket.gethostname())


def _only(headers: Headers, name: str) -> str | None:
    values = headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _name(host: str) -> str | None:
    """Return the name in a Host header, in lower case; None if there is none.

    >>> _name("localhost:8080"), _name("[::1]:8080"), _name("[::1]"), _name("a:b"), _name("")
    ('localhost', '::1', '::1', None, None)
    """
    found = re.fullmatch(r"(?:\[([0-9a-f:.]+)\]|([\w.-]+))(?::\d{1,5})?", host.lower(), re.ASCII)
    return None if found is None else found[1] or found[2]


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _quoted(text: str | None) -> str:
    return "none" if text is None else ascii(text[:80])
