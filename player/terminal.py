"""Output for a terminal: text from files without control characters, and an asset's picture, two pixels per
character (upper half blocks), if the terminal has 16 million colours."""

from __future__ import annotations

import os
import re
import shlex
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:  # imported before `--help` is answered, which needs no numpy
    import numpy as np

    from player.asset.asset import Asset

ROWS = 16
"""Lines of the picture on the `--info` page."""


def command_line(*words: str) -> str:
    """Return the words as a command that can be pasted into this system's shell.

    >>> command_line("vfr-play", "out", "--info")
    'vfr-play out --info'
    """
    if os.name == "nt":  # whose shells know double quotes alone; a path with backslashes needs none
        return " ".join(word if re.fullmatch(r"[\w\\/:.,=+-]+", word) else f'"{word}"' for word in words)
    return shlex.join(words)


def printable(text: str) -> str:
    r"""Return the text in one line, with escapes for characters that a terminal or a browser would obey
    instead of showing: control characters, line ends, changes of the writing direction, halves of surrogate
    pairs.

    >>> printable("a\x1b[2Jb\u202ec\n\u00fc \u732b")
    'a\\x1b[2Jb\\u202ec\\nü 猫'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def picture_lines(asset: Asset, stream: TextIO) -> list[str]:
    """Render the asset from its first training view as lines for `stream`; no lines if it cannot show
    colours."""
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
    frame = render(asset, small, march="numpy")  # numpy: nothing to compile, and 64 rows take only a moment
    halves = frame.to_uint8().reshape(2 * ROWS, 2, columns, 2, 3).mean(axis=(1, 3))
    return [*half_blocks((halves + 0.5).astype(np.uint8)), ""]


def half_blocks(pixels: np.ndarray) -> list[str]:
    """Turn pixels [2 n, columns, 3] uint8 into n lines of upper half blocks.

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
