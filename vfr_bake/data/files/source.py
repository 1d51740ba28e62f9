"""The file that a folder was made from, a ZIP or a video. It is noted in the folder, so that the folder is
not taken for that of another file."""

from __future__ import annotations

import re
from pathlib import Path

from player.errors import DataError, FormatError
from player.files.files import read_bytes

NAME = "source.txt"
"""Name of the file that has the name of the source and its size in bytes, one a line."""


def note_source(folder: Path, source: Path) -> None:
    """Note in `folder` that it is made from the file `source`."""
    (folder / NAME).write_bytes(_note(source))


def check_source(folder: Path, source: Path) -> None:
    """Raise DataError if `folder` has a note that it was made from another file than `source`. A folder
    without a note is trusted, and so is one whose source is gone."""
    path = folder / NAME
    if path.exists() and source.exists() and read_bytes(path, "the name of a file", 10_000) != _note(source):
        raise DataError(
            f"{folder}: expected to be made from {source.name} as it is now, got a folder that was made from "
            "another file: remove it, or name the folder itself to use it"
        )


def is_made(folder: Path) -> bool:
    """Return whether `folder` has a note of what it was made from.

    >>> is_made(Path("surely/not/there"))
    False
    """
    try:
        note = read_bytes(folder / NAME, "the name of a file", 10_000)
    except FormatError:
        return False
    return re.fullmatch(rb"'.+'\n[0-9]+\n|\".+\"\n[0-9]+\n", note) is not None


def _note(source: Path) -> bytes:
    return f"{source.name!a}\n{source.stat().st_size}\n".encode()
