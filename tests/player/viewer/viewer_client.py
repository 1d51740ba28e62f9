"""A client of the viewer without a browser: its messages on a real WebSocket."""

from __future__ import annotations

import http.client
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import viser
import zstandard
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

REPOSITORY = Path(__file__).resolve().parents[3]
SECONDS = 120.0
"""Longest wait for a busy machine, in seconds; a test that passes never waits that long."""

SPOKEN = [Subprotocol(f"viser-v{viser.__version__}")]

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": [0.5, -0.5, 0.5, -0.5],
    "position": [9.0, 2.0, 3.0],
    "fov": 0.8,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 60,
    "image_width": 80,
    "look_at": [1.0, 2.0, 3.0],
    "up_direction": [0.0, 0.0, 1.0],
}


class Server:
    """A process of `vfr-play ASSET ...`, which serves the viewer."""

    def __init__(self, errors: Path, *arguments: str | Path, program: str = "") -> None:
        """Start the process; `program` is Python code that it runs first."""
        environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
        self.errors = errors
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell sets it for background jobs
            signal.signal(signal.SIGINT, signal.default_int_handler)
        code = f"{program}\nimport sys\nfrom player.app.cli import main\nsys.exit(main())"
        start = ["-c", code] if program else ["-m", "player"]
        with errors.open("w") as file:
            self.process = subprocess.Popen(
                [sys.executable, *start, *map(str, arguments)],
                env=environment | {"PYTHONPATH": str(REPOSITORY)},
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
            )
        assert self.process.stdout is not None
        self.line = self.process.stdout.readline()
        found = re.search(r"http://\S+:(\d+)", self.line)
        assert found, self.line + errors.read_text()
        self.address, self.port = found[0], int(found[1])

    def stop(self) -> int:
        """End the process by Ctrl-C; return its exit code."""
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(SECONDS)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code

    def resident_mb(self) -> float:
        """Return the memory, in MB, that the process holds now (Linux)."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * 4096 / 1e6


def get(server: Server, headers: dict[str, str], path: str = "/") -> tuple[int, str]:
    """Return the status and text of the server's answer to a request with these headers alone."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=SECONDS)
    connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    text = answer.read().decode(errors="replace")
    connection.close()
    return answer.status, text


def opened(
    server: Server, host: str | None = None, origin: str | None = "", **options: Any
) -> ClientConnection:
    """Open a WebSocket as a page of the server does, which claims this `host` and `origin`."""
    name = host or f"127.0.0.1:{server.port}"
    given = f"http://{name}" if origin == "" else origin
    return connect(
        f"ws://{name}",
        sock=socket.create_connection(("127.0.0.1", server.port), SECONDS),
        origin=None if given is None else Origin(given),
        **{"subprotocols": SPOKEN, "max_size": None, "compression": None, "ping_interval": None, **options},
    )


def decoded(batch: bytes | str) -> list[dict[str, Any]]:
    """Return the messages in one batch of the server."""
    assert isinstance(batch, bytes)
    size, packed = int.from_bytes(batch[:8], "little"), int.from_bytes(batch[8:16], "little")
    inner = zstandard.ZstdDecompressor().decompress(batch[16 : 16 + packed], max_output_size=size)
    return msgspec.msgpack.decode(inner)["messages"]


class Client:
    """A client that does what a page does, as far as tests need it."""

    def __init__(self, server: Server, **options: Any) -> None:
        self.socket = opened(server, **options)
        self.controls: dict[str, str] = {}
        """The ids of controls in messages, by their labels."""

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, message: dict[str, Any]) -> None:
        self.socket.send(msgspec.msgpack.encode(message))

    def move(self, **changes: Any) -> None:
        """Send the camera `CAMERA`, with these fields changed."""
        self.send(CAMERA | changes)

    def set(self, label: str, value: Any) -> None:
        """Set the control that has this label."""
        self.send({"type": "GuiUpdateMessage", "uuid": self.controls[label], "updates": {"value": value}})

    def messages(self, seconds: float = SECONDS) -> Iterator[dict[str, Any]]:
        """Yield the server's messages, until it has sent nothing for `seconds`."""
        while True:
            try:
                batch = self.socket.recv(seconds)
            except TimeoutError:
                return
            batch = decoded(batch)
            for message in batch:
                label = message.get("props", {}).get("label") if "uuid" in message else None
                if label:
                    self.controls[label] = message["uuid"]
            yield from batch

    def picture(self) -> bytes:
        """Return the next picture, a JPEG."""
        for message in self.messages():
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                return message["rgb_data"]
        raise AssertionError("no picture")

    def sizes(self, last: Callable[[int, int], object]) -> list[tuple[int, int]]:
        """Return the sizes of the pictures that come, up to the first for which `last` is true."""
        sizes = []
        for message in self.messages():
            state = message["updates"].get("value") if message["type"] == "GuiUpdateMessage" else None
            found = re.match(r"(\d+)x(\d+),", str(state))
            if found:
                sizes.append((int(found[1]), int(found[2])))
                if last(*sizes[-1]):
                    return sizes
        raise AssertionError(f"no picture of the size, but {sizes}")


def still_serves(server: Server) -> None:
    """Assert that a new client gets a picture, and another one after a move."""
    end = time.monotonic() + SECONDS
    with Client(server) as client:
        client.move()
        client.picture()
        client.move(position=[8.0, 2.5, 3.0])
        client.picture()
    assert time.monotonic() < end
