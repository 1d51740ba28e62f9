"""The viewer, served at an address of this machine."""

from __future__ import annotations

import errno
import os
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

from player.asset.asset import Asset
from player.cameras.camera import focus_point, orbit, world_up
from player.cameras.views import asset_cameras
from player.errors import ConfigError, MissingExtraError
from player.files.memory import allowed_bytes
from player.render import (
    Background,
    March,
    Quality,
    Renderer,
    check_choice,
    checked_background,
    checked_samples,
)
from player.terminal import command_line, printable
from player.threads import bounded_threads
from player.viewer.growing import grow, tell_what_is_missing
from player.viewer.pages import NO_PAGES, Pages
from player.viewer.window import PictureChoices, ViserFrame, Window, field_of_view

PORT = 8080
PORTS = 100
"""Number of ports, from PORT on, that are tried where none was asked for."""
EVERY_ADDRESS = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}
"""The hosts that stand for all addresses of this machine, and the address by which the machine reaches each.
A server at `::` answers IPv6 alone."""


@dataclass(frozen=True)
class ServeSettings:
    """Settings of `player.serve`. Raises ConfigError for settings that are out of range, and for a
    transparent background."""

    host: str = "127.0.0.1"
    """Address to serve at; as it is, this machine alone is let in."""
    port: int | None = None
    """Port; the first that is free from 8080 on if None."""
    samples: int | None = None
    """Feature fetches a ray; the asset's own number if None, every sample if 0."""
    quality: Quality | None = None
    """That of all pictures; if None, "fast" while the camera moves and "exact" when it stands still."""
    background: Background | None = None
    """Colour, 3 numbers 0..1; the asset's own if None."""
    threads: int | None = None
    """Threads that render; one for each core if None."""
    march: March = "auto"
    """Implementation: "numba", "numpy", or numba where it is there ("auto")."""
    max_memory: float | None = None
    """Gigabytes that an asset may take when it is opened for its page; half of the machine's if None."""

    def __post_init__(self) -> None:
        if self.port is not None and not (isinstance(self.port, int) and 1 <= self.port <= 65535):
            raise ConfigError(f"port: expected 1 to 65535, got {self.port!r}")
        if self.samples is not None:
            object.__setattr__(self, "samples", checked_samples(self.samples))
        if self.quality is not None:
            check_choice("quality", self.quality, get_args(Quality))
        if self.background is not None:
            object.__setattr__(self, "background", checked_background(self.background))
        check_choice("march", self.march, get_args(March))
        if self.threads is not None:
            bounded_threads(self.threads)
        if self.max_memory is not None:
            allowed_bytes(self.max_memory)
        if self.background == "transparent":
            raise ConfigError("--background: expected a colour for the viewer, got transparent")


@contextmanager
def serve(
    assets: Asset | Iterator[Asset] | Sequence[Asset | Iterator[Asset]],
    settings: ServeSettings = ServeSettings(),
    say: Callable[[str], object] = lambda text: None,
) -> Iterator[str]:
    """Serve the viewer while a `with` block runs; the block is given its address.

    Args:
        assets: one or more assets, to switch between; the cameras are those of the first. Each is an open
            asset, or what `Asset.growing` returns: it is shown as soon as its first part is read, and more
            sharply with each further part.
        settings: where it is served, and how pictures are rendered.
        say: called with each line that a person should know before long work begins.

    Raises:
        MissingExtraError: viser is not installed, or is one whose connections cannot be checked; or numba
            where it is asked for and does not run.
        ConfigError: there are no assets, or the address cannot be had.
        VfrError: of an asset that grows, not even the first part can be read.

    >>> import player
    >>> with player.serve(player.Asset.open("out/"), player.ServeSettings(march="numpy")) as address:
    ...     address.rpartition(":")[0]  # a program that serves for long waits here, as `input()` does
    'http://127.0.0.1'
    """
    given = [assets] if isinstance(assets, Asset | Iterator) else assets
    if not given:
        raise ConfigError("assets: expected at least one, got none")
    firsts = [asset if isinstance(asset, Asset) else next(asset) for asset in given]
    for first in firsts:
        tell_what_is_missing(first, say)
    _need_viser(firsts[0])
    port = free_port(settings.host, settings.port)
    if settings.march != "numpy":
        from player.proof import prove

        prove(say)
    # viser's warning when a client leaves while something is sent to it
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
    with ExitStack() as stack:
        renderers = [
            stack.enter_context(Renderer(first, settings.threads, settings.march)) for first in firsts
        ]
        pages = Pages([partial(_page, first.folder, settings) for first in firsts])
        title = f"{printable(firsts[0].folder.resolve().name)} - vfr-play"
        server = guarded_server(settings.host, port, title, pages)
        windows: dict[int, Window] = {}
        stopped = threading.Event()
        try:
            windows = open_windows(server, renderers, settings)

            def changed() -> None:
                for window in list(windows.values()):
                    window.touch()

            later = [
                (renderer, asset)
                for renderer, asset in zip(renderers, given, strict=True)
                if not isinstance(asset, Asset)
            ]
            reading = (later, changed, say, stopped)
            threading.Thread(target=grow, args=reading, name="vfr-read", daemon=True).start()
            yield f"http://{_shown(settings.host)}:{server.get_port()}"
        finally:
            stopped.set()
            for window in list(windows.values()):
                window.close()
            pages.close()
            with _viser_silenced():
                server.stop()


def address_for_others(host: str, address: str) -> str:
    """Return the address by which other machines reach the viewer at `host`, which this machine reaches by
    `address`: another one if the viewer serves at every address of this machine."""
    from player.viewer.guard import own_name

    name = own_name() if host in EVERY_ADDRESS else None
    return address if name is None else f"http://{name}:{address.rpartition(':')[2]}"


def guarded_server(host: str, port: int, title: str = "", pages: Pages = NO_PAGES) -> Any:
    """Start viser's server, with `player.viewer.guard` before every connection, and `pages` beside it.

    Raises MissingExtraError for a viser that cannot be guarded.
    """
    import viser

    from player.viewer.guard import Guard, every_connection_checked

    server = None
    try:
        with every_connection_checked(Guard(host, viser.__version__, pages)), _viser_silenced():
            server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    except MissingExtraError:
        if server is not None:
            server.stop()
        raise
    return server


@contextmanager
def _viser_silenced() -> Iterator[None]:
    """Drop what viser prints while a `with` block runs: it has no setting for that, and scripts read the one
    line that vfr-play prints. All else that the program prints, on any thread, is printed."""
    import rich

    original = rich.print

    def of_others(*args: Any, **kwargs: Any) -> None:
        if not sys._getframe(1).f_globals["__name__"].startswith("viser."):
            original(*args, **kwargs)

    rich.print = of_others
    try:
        yield
    finally:
        rich.print = original


def _page(folder: Path, settings: ServeSettings) -> bytes:
    """Make the page of an asset with all of its parts, even those that the viewer has not read yet."""
    from player.page.page import page

    asset = Asset.open(folder, max_memory=settings.max_memory)
    return page(asset, n_threads=settings.threads, march=settings.march)


def open_windows(
    server: Any, renderers: Sequence[Renderer], settings: ServeSettings = ServeSettings()
) -> dict[int, Window]:
    """Give every client of a guarded server a window, and end it when the client is gone.

    Returns the open windows by the clients' numbers. The cameras are those of the first asset.
    """
    from player.viewer.guard import CONNECTION

    chosen = PictureChoices(settings.samples, settings.quality, settings.background)
    trained = asset_cameras(renderers[0].asset)
    focus = focus_point(trained)
    first = orbit(trained, 1)[0]
    frame = ViserFrame.around(focus, first)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    server.scene.set_up_direction(world_up(trained))
    server.initial_camera.position = frame.from_world(first.c2w[:3, 3])
    server.initial_camera.look_at = frame.from_world(focus)
    server.initial_camera.fov = field_of_view(first, first.width, first.height)
    windows: dict[int, Window] = {}
    whole = threading.Lock()

    @server.on_client_connect
    async def _(client: Any) -> None:  # a coroutine, since CONNECTION is not set for plain functions
        client.camera.fov = field_of_view(first, client.camera.image_width, client.camera.image_height)
        window = Window(client, CONNECTION.get(), renderers, trained, frame, chosen, whole)
        windows[client.client_id] = window
        window.start()

    @server.on_client_disconnect
    def _(client: Any) -> None:
        window = windows.pop(client.client_id, None)
        if window is not None:
            window.close()

    return windows


def free_port(host: str, asked: int | None) -> int:
    """Return the port that was asked for, or the first free one from PORT on.

    Ports are tried here, because the server would look for another port without end. Raises ConfigError if
    none is free, or if this machine has no such address.
    """
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, asked or PORT, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise _no_address(host, error) from None
    reason = ""
    for port in [asked] if asked is not None else range(PORT, PORT + PORTS):
        try:
            with socket.socket(family, kind) as trial:
                if os.name == "posix":  # a port whose last connection has just ended is free
                    trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind((address[0], port, *address[2:]))
            return port
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise _no_address(host, error) from None
            reason = error.strerror or str(error)
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):  # another port would not help
                break
    what = f"--port {asked}" if asked is not None else f"ports {PORT} to {PORT + PORTS - 1}"
    raise ConfigError(f"viewer: {what} at {host}: expected a free port, got: {reason}")


def _no_address(host: str, error: OSError | UnicodeError) -> ConfigError:
    reason = getattr(error, "strerror", None) or str(error)
    return ConfigError(f"--host: expected an address of this machine, got {printable(host)}: {reason}")


def _need_viser(asset: Asset) -> None:
    try:
        import viser  # noqa: F401
    except ImportError as error:
        files = command_line("vfr-play", str(asset.folder), "--orbit", "60", "--output", "frames/")
        raise MissingExtraError(
            "viewer: expected the package viser, which is not installed: pip install 'vfr-bake[viewer]'; "
            f"or render files: {files}"
        ) from error


def _shown(host: str) -> str:
    """Return the host for an address by which a browser on this machine reaches the viewer."""
    if host in EVERY_ADDRESS:
        return EVERY_ADDRESS[host]
    return f"[{host}]" if ":" in host else host
