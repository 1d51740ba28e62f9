"""The command `vfr-play`, which shows an asset in a browser, renders it to files, or prints what is in it."""

from __future__ import annotations

import argparse
import os
import sys
import threading
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from player.app.commands import check_result, run, write_result
from player.app.option_types import DEMO
from player.app.options import PlaySettings, given, parse, settings_of
from player.errors import ConfigError, FormatError, VfrError
from player.progress import Bar, duration
from player.terminal import command_line, picture_lines, printable

if TYPE_CHECKING:  # `--help` answers without numpy
    from player.app.frame_files import Target
    from player.app.play import Played
    from player.asset.asset import Asset
    from player.cameras.camera import Camera


RESULTS = (
    {"ms_median", "frames", "peak_rss_mb"},
    {"bytes_total", "n_bricks", "world_box"},  # --info
    {"ok", "files"},  # --check
)
"""Keys by which a JSON file is known as an earlier result, which is replaced."""


def main(argv: list[str] | None = None) -> int:
    """Run `vfr-play`; returns the exit code: one of `player.app.commands.run`, or 2 for wrong usage."""
    try:
        return run("vfr-play", lambda: _run(parse(argv)))
    except SystemExit as leave:  # argparse has printed why
        return leave.code if isinstance(leave.code, int) else 2


def _run(arguments: argparse.Namespace) -> int:
    inputs = [arguments.asset, *([] if arguments.cameras is None else [arguments.cameras])]
    check_result(arguments.json, inputs, RESULTS, arguments.output)
    if arguments.check:
        return _check(arguments)
    if arguments.info:
        return _info(arguments)
    if arguments.output is None:
        # The demo must work without any extra installed. Other options and more assets need the viewer.
        demo_alone = arguments.asset == DEMO and set(given(arguments)) <= {"max_memory"}
        no_viewer = demo_alone and find_spec("viser") is None
        return _open_page(arguments) if no_viewer else _view(arguments)
    return _play(arguments)


def _view(arguments: argparse.Namespace) -> int:
    from player.asset.asset import Asset
    from player.render import import_ahead
    from player.viewer.server import ServeSettings, address_for_others, serve

    settings = settings_of(ServeSettings, arguments)
    import_ahead()
    folders = (arguments.asset, *arguments.others)
    assets = [Asset.growing(folder, max_memory=arguments.max_memory) for folder in folders]
    with serve(assets, settings, _say) as address:
        print(f"{arguments.asset}: look at it at {address}", flush=True)
        _advise(arguments.asset, address, address_for_others(settings.host, address))
        forever = threading.Event()
        while not forever.wait(1):  # on Windows, Ctrl-C does not interrupt a wait without a timeout
            pass
    return 0


def _open_page(arguments: argparse.Namespace) -> int:
    """Write the asset's page to a new temporary folder, and open it in a browser if there is a display."""
    import tempfile
    import webbrowser

    from player.files.files import write_bytes
    from player.page.page import page

    path = Path(tempfile.mkdtemp(prefix="vfr-play-")) / f"{arguments.asset.name}.html"
    write_bytes(path, page(_open(arguments.asset, arguments)))
    print(f"{path}: open it in any browser", flush=True)
    _say("this page is drawn by the browser; the viewer is an extra: pip install 'vfr-bake[viewer]'")
    if _has_display():
        webbrowser.open(path.as_uri())
    return 0


def _open(folder: Path, arguments: argparse.Namespace) -> Asset:
    """Open an asset, or as much of it as there is; a line then says what is missing."""
    from player.asset.asset import Asset

    asset = Asset.open(folder, max_memory=arguments.max_memory)
    if asset.missing is not None:
        _say(f"warning: {printable(asset.missing)}")
    return asset


def _advise(asset: Path, address: str, visitors: str) -> None:
    """Say how to end the viewer, and what to do if no browser can open on this machine.

    `address`, `visitors`: where browsers of this machine and of others find the viewer.
    """
    _say(f"for many visitors, each with the GPU of their own device: {visitors}/page")
    _say("the viewer runs until Ctrl-C")
    if not _has_display():
        place = address.removeprefix("http://")
        port = place.rpartition(":")[2]
        _say(f"no display here: from a machine that has one, ssh -L {port}:{place} to this")
        files = command_line("vfr-play", str(asset), "--orbit", "60", "--output", "frames/")
        _say(f"and open http://127.0.0.1:{port} there; or render files: {files}")


def _has_display() -> bool:
    """Return whether a browser can open a window here, as far as the system tells."""
    windows = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or bool(windows)


def _play(arguments: argparse.Namespace) -> int:
    from player.app.frame_files import Target

    target = Target.of(settings_of(PlaySettings, arguments))
    try:
        played = _play_on_a_bar(arguments, target)
    except KeyboardInterrupt:
        if target.is_picture:
            raise
        raise KeyboardInterrupt(
            f"the frames that were finished are kept in {target.folder}; --resume goes on"
        ) from None
    write_result(arguments.json, played.figures, _sentence(target.path, played))
    return 0


def _play_on_a_bar(arguments: argparse.Namespace, target: Target) -> Played:
    from player.app.play import play
    from player.cameras.views import frame_rate
    from player.render import import_ahead

    settings = settings_of(PlaySettings, arguments)
    target.check(settings)  # so that a refusal comes before the asset is opened
    import_ahead(scipy=False)
    asset = _open(arguments.asset, arguments)
    cameras = _views(asset, arguments)
    if target.is_video and arguments.fps is None and arguments.cameras is not None:
        settings = replace(settings, fps=frame_rate(arguments.cameras) or settings.fps)
    with Bar(lines=False) as bar:

        def advance(n_done: int, n_frames: int, milliseconds: float) -> None:
            bar.share(n_done / n_frames, f"frame {n_done}/{n_frames}  {milliseconds:.0f} ms")

        return play(asset, cameras, settings, _say, advance)


def _views(asset: Asset, arguments: argparse.Namespace) -> list[Camera]:
    """Return the cameras that --cameras, --orbit or --view ask for, in the size that --size asks for."""
    from player.cameras.camera import orbit
    from player.cameras.views import asset_cameras, read_views

    width, height = asset.manifest.view_size
    file = arguments.cameras
    cameras = asset_cameras(asset) if file is None else read_views(file, (width, height), _say)
    if arguments.orbit is not None:
        return orbit(cameras, arguments.orbit, arguments.size or (width, height))
    if arguments.view is not None:
        n = len(cameras)
        if not -n <= arguments.view < n:
            raise ConfigError(f"--view: expected 0 to {n - 1}, got {arguments.view}")
        cameras = [cameras[arguments.view]]
    return cameras if arguments.size is None else [camera.fitted(*arguments.size) for camera in cameras]


def _sentence(path: Path, played: Played) -> str:
    figures, n_kept = played.figures, played.n_kept
    n, ms = figures["frames"], figures["ms_median"]
    kept = f" ({n_kept} were there already)" if n_kept else ""
    what = f"{n} picture{'s' * (n != 1)}{kept} of {figures['width']}x{figures['height']}"
    if ms is None:
        return f"{path}: {what}, nothing left to render"
    seconds = duration(played.seconds) if played.seconds >= 60 else f"{played.seconds:.1f} s"
    return (
        f"{path}: {what} in {seconds}; rendering {ms:.0f} ms a frame "
        f"({1000 / ms:.1f} frames/s, {figures['march']}, {figures['threads']} threads)"
    )


def _say(text: str) -> None:
    print(f"vfr-play: {text}", file=sys.stderr)


def _check(arguments: argparse.Namespace) -> int:
    from player.asset.asset import Asset, checksums, read_manifest
    from player.asset.folder import check_total
    from player.files.memory import allowed_bytes
    from player.head.head import asset_head

    manifest = read_manifest(arguments.asset)
    check_total(arguments.asset, manifest.files, allowed_bytes(arguments.max_memory))
    results = {}
    for name, error in checksums(arguments.asset, manifest):
        results[name] = "ok" if error is None else str(error)
        if arguments.json != "-":
            found = "" if error is None else f"  {printable(str(error))}"
            print(f"{'ok    ' if error is None else 'FAILED'}  {name}{found}")
    error = None
    if failed := sum(result != "ok" for result in results.values()):
        error = VfrError(f"{arguments.asset}: {failed} of {len(results)} files failed")
    else:  # the checksums hold; now the content
        try:
            asset = Asset.open(arguments.asset, max_memory=arguments.max_memory)
            if asset.missing is not None:
                raise FormatError(asset.missing)
            asset_head(asset)
        except VfrError as found:
            error = found
    write_result(arguments.json, {"ok": error is None, "files": results}, None)
    if error is not None:
        raise error
    return 0


def _info(arguments: argparse.Namespace) -> int:
    from player.app.info import facts, page

    asset = _open(arguments.asset, arguments)
    known = facts(asset)
    lines = [] if arguments.json == "-" else picture_lines(asset, sys.stdout)
    text = "\n".join([*lines, *page(arguments.asset, asset.manifest, known)])
    write_result(arguments.json, known, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
