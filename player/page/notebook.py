"""A page within a notebook."""

from __future__ import annotations

import html
from dataclasses import dataclass, field

from player.asset.asset import Asset
from player.page.page import page


@dataclass(frozen=True)
class Inline:
    """A page that a notebook (Jupyter and others) shows below a cell; made by `inline`."""

    content: bytes = field(repr=False)
    """The page, as HTML."""
    height: int
    """Height of the frame in pixels."""

    def _repr_html_(self) -> str:
        """Return the page in a frame that cannot reach anything of the notebook."""
        text = html.escape(self.content.decode("ascii"))
        style = f"width: 100%; height: {self.height}px; border: 0"
        allowed = 'sandbox="allow-scripts allow-downloads" allow="fullscreen"'
        return f'<iframe srcdoc="{text}" {allowed} style="{style}"></iframe>'


def inline(asset: Asset, height: int = 480) -> Inline:
    """Make the page of an asset, which a notebook shows below a cell whose last value it is.

    Args:
        asset: an open asset. The page shows the parts with which it was opened.
        height: of the frame, pixels.

    Raises:
        ConfigError, FormatError: as `player.page.page`.

    >>> inline(Asset.open("out/"), height=300)
    Inline(height=300)
    """
    return Inline(page(asset), height)
