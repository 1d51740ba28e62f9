"""Reading further parts of assets while the viewer shows the first ones."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence

from player.asset.asset import Asset
from player.errors import VfrError
from player.render import Renderer
from player.terminal import printable


class Growing:
    """A thread that reads further parts of assets, while the windows show what is read already."""

    def __init__(
        self,
        growing: Sequence[tuple[Renderer, Iterator[Asset]]],
        changed: Callable[[], object],
        say: Callable[[str], object],
    ) -> None:
        """Start the thread.

        Args:
            growing: for each asset, the renderer that shows it, and an iterator that yields the same asset
                with more and more of its parts. The assets are read one after the other.
            changed: called whenever there is more to see.
            say: called with a line for each asset of which some parts cannot be read.
        """
        self._growing, self._changed, self._say = growing, changed, say
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vfr-read", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop reading after the part that is being read, without waiting for it."""
        self._stopped.set()

    def _run(self) -> None:
        for renderer, sharper in self._growing:
            try:
                for asset in sharper:
                    if self._stopped.is_set():
                        return
                    renderer.show(asset)
                    self._changed()
                    tell_what_is_missing(asset, self._say)
            except VfrError as error:
                shown = f"shown as its first {renderer.asset.n_parts} parts have it"
                self._say(f"warning: {printable(str(error))}: {shown}")


def tell_what_is_missing(asset: Asset, say: Callable[[str], object]) -> None:
    """Say in a line what is missing, if an asset is not whole."""
    if asset.missing is not None:
        say(f"warning: {printable(asset.missing)}")
