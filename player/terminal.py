"""Showing in a terminal: text from files without its control characters, and an asset's picture of two pixels
a character (upper half blocks) where the terminal has 16 million colours."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:  # commands import this before they answer `--help`, which needs no numpy
    import numpy as np

    from player.asset.asset import Asset

ROWS = 16
"""Lines of the picture on the `--info` page."""


def printable(text: str) -> str:
    r"""The text in one line, with escapes in place of what a terminal or a browser obeys instead of showing:
    control characters, ends of lines, changes of the writing direction, halves of characters.

    >>> printable("a\x1b[2Jb\u202ec\n\u00fc \u732b")
    'a\\x1b[2Jb\\u202ec\\nü 猫'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def picture_lines(asset: Asset, stream: TextIO) -> list[str]:
    """The asset from its first training view, as lines for `stream`; none where it cannot show colours."""
    encoding = (getattr(stream, "encoding", None) or "").lower().replace("-", "")
    if not (stream.isatty() and encoding == "utf8" and os.environ.get("COLORTERM") in ("truecolor", "24bit")):
        return []
    import numpy as np

    from player.cameras.views import asset_cameras
    from player.render import render

    camera = asset_cameras(asset)[0]
    width = os.get_terminal_size(stream.fileno()).columns or 80  # 0 where the terminal does not tell
    columns = max(min(round(2 * ROWS * camera.width / camera.height), width), 1)
    small = camera.resized(2 * columns, 4 * ROWS)
    frame = render(asset, small, march="numpy")  # nothing to compile: 64 rows take a moment
    halves = frame.to_uint8().reshape(2 * ROWS, 2, columns, 2, 3).mean(axis=(1, 3))
    return [*half_blocks((halves + 0.5).astype(np.uint8)), ""]


def half_blocks(pixels: np.ndarray) -> list[str]:
    """Lines of upper half blocks: [2 n, columns, 3] uint8 to n lines.

    >>> import numpy as np
    >>> half_blocks(np.uint8([[[1, 2, 3]], [[4, 5, 6]]]))
    ['\\x1b[38;2;1;2;3;48;2;4;5;6m▀\\x1b[0m']
    """
    lines = []
    for above, below in zip(pixels[::2].tolist(), pixels[1::2].tolist(), strict=True):
        cells = (
            "\x1b[38;2;{};{};{};48;2;{};{};{}m▀".format(*top, *bottom)
            for top, bottom in zip(above, below, strict=True)
        )
        lines.append("".join(cells) + "\x1b[0m")
    return lines
