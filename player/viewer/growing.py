"""Reading further parts of assets while the viewer shows the first ones."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator

from player.asset.asset import Asset
from player.errors import VfrError
from player.render import Renderer
from player.terminal import printable


def grow(
    growing: Iterable[tuple[Renderer, Iterator[Asset]]],
    changed: Callable[[], object],
    say: Callable[[str], object],
    stopped: threading.Event,
) -> None:
    """Read further parts of assets, which windows show at the same time.

    Args:
        growing: for each asset, the renderer that shows it, and an iterator that yields the same asset with
            more and more of its parts. The assets are read one after the other.
        changed: called whenever there is more to see.
        say: called with a line for each asset of which some parts cannot be read.
        stopped: once it is set, nothing more is read after the part that is being read.
    """
    for renderer, sharper in growing:
        try:
            for asset in sharper:
                if stopped.is_set():
                    return
                renderer.show(asset)
                changed()
                tell_what_is_missing(asset, say)
        except VfrError as error:
            shown = f"shown as its first {renderer.asset.n_parts} parts have it"
            say(f"warning: {printable(str(error))}: {shown}")


def tell_what_is_missing(asset: Asset, say: Callable[[str], object]) -> None:
    """Say in a line what is missing, if an asset is not whole."""
    if asset.missing is not None:
        say(f"warning: {printable(asset.missing)}")
