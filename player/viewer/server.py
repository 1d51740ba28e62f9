"""`vfr-play out/`: the viewer at an address of this machine, until Ctrl-C."""

from __future__ import annotations

import argparse
import io
import os
import socket
import sys
import threading
import warnings
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from typing import Any

import numpy as np

from player.asset.asset import Asset
from player.cameras.camera import focus_point, orbit, world_up
from player.cameras.transforms import read_cameras
from player.errors import ConfigError, MissingExtraError
from player.render import Renderer, import_ahead
from player.terminal import printable
from player.viewer.window import Window

HOST = "127.0.0.1"
PORT = 8080
PORTS = 100
"""So many ports from the first on are tried, unless one was asked for."""


def serve(arguments: argparse.Namespace) -> None:
    """Serve the viewer until KeyboardInterrupt; prints its address.

    Raises MissingExtraError without viser, ConfigError for an address that cannot be had, and what
    `Asset.open` and `Renderer` raise.
    """
    files = f"vfr-play {arguments.asset} --orbit 60 --output frames/"
    if arguments.background == "transparent":
        raise ConfigError("--background: expected a colour for the viewer, got transparent")
    _need_viser(files)
    import_ahead()
    folders = (arguments.asset, *arguments.others)
    assets = [Asset.open(folder, max_memory=arguments.max_memory) for folder in folders]
    host = arguments.host or HOST
    port = free_port(host, arguments.port)
    if arguments.march != "numpy":
        from player.proof import prove

        prove(lambda text: sys.stderr.write(f"vfr-play: {text}\n"))
    with ExitStack() as stack, warnings.catch_warnings():
        # what viser says where a client goes while something is sent to it
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        renderers = [
            stack.enter_context(Renderer(asset, arguments.threads, arguments.march)) for asset in assets
        ]
        server = guarded_server(host, port, _title(assets[0]))
        try:
            windows = open_windows(server, renderers, arguments.samples, arguments.background)
            sys.stdout.write(f"{arguments.asset}: look at it at http://{_shown(host)}:{server.get_port()}\n")
            sys.stdout.flush()
            sys.stderr.write(_advice(files, server.get_port()))
            forever = threading.Event()
            while not forever.wait(1):  # a wait without end hears no Ctrl-C on Windows
                pass
        finally:
            for window in list(windows.values()):
                window.close()
            with redirect_stdout(io.StringIO()):
                server.stop()


def guarded_server(host: str, port: int, title: str = "") -> Any:
    """viser's server, with `player.viewer.guard` before every connection.

    Raises MissingExtraError for a viser that cannot be guarded.
    """
    import viser

    from player.viewer.guard import Guard, every_connection_checked

    server = None
    try:
        # its banner: ours is the one line that scripts read
        with every_connection_checked(Guard(host, viser.__version__)), redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    except MissingExtraError:
        if server is not None:
            server.stop()
        raise
    return server


def open_windows(
    server: Any, renderers: Sequence[Renderer], samples: int | None, background: Any
) -> dict[int, Window]:
    """Give every client of a guarded server a window, and end it when the client is gone; returns those that
    are open. Cameras are those of the first asset."""
    from player.viewer.guard import CONNECTION

    asset = renderers[0].asset
    width, height = asset.manifest.view_size
    trained = read_cameras(asset.path("cameras.json"), (width, height))
    focus = focus_point(trained)
    first = orbit(trained, 1)[0]
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    server.scene.set_up_direction(world_up(trained))
    server.initial_camera.position = first.c2w[:3, 3]
    server.initial_camera.look_at = focus
    server.initial_camera.fov = fov = float(2 * np.arctan(first.height / 2 / first.fy))
    windows: dict[int, Window] = {}
    whole = threading.Lock()

    @server.on_client_connect
    async def _(client: Any) -> None:  # awaited where its connection is known; a plain function is not
        client.camera.fov = fov
        window = Window(client, CONNECTION.get(), renderers, trained, focus, samples, background, whole)
        windows[client.client_id] = window
        window.start()

    @server.on_client_disconnect
    def _(client: Any) -> None:
        window = windows.pop(client.client_id, None)
        if window is not None:
            window.close()

    return windows


def free_port(host: str, asked: int | None) -> int:
    """The port that was asked for, or the first free one from PORT on.

    Tried here, because the server looks for another port without end. Raises ConfigError.
    """
    reason = ""
    for port in [asked] if asked is not None else range(PORT, PORT + PORTS):
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind) as trial:
                if os.name == "posix":  # a port whose last connection has just ended is free
                    trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind(address)
            return port
        except OSError as error:
            reason = error.strerror or str(error)
    what = f"--port {asked}" if asked is not None else f"ports {PORT} to {PORT + PORTS - 1}"
    raise ConfigError(f"viewer: {what} at {host}: expected a free port, got: {reason}")


def _need_viser(files: str) -> None:
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(
            "viewer: expected the package viser, which is not installed: pip install 'vfr-bake[viewer]'; "
            f"or render files: {files}"
        ) from error


def _title(asset: Asset) -> str:
    return f"{printable(asset.folder.resolve().name)} - vfr-play"


def _shown(host: str) -> str:
    """The host as a browser on this machine reaches it."""
    if host in ("0.0.0.0", "::"):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def _advice(files: str, port: int) -> str:
    """What to do where no browser can open here."""
    lines = ["vfr-play: the viewer runs until Ctrl-C"]
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        lines += [
            f"vfr-play: no display here: from a machine that has one, ssh -L {port}:127.0.0.1:{port} to this",
            f"vfr-play: and open that address there; or render files: {files}",
        ]
    return "\n".join(lines) + "\n"
