"""What is in the files and folders that are to be written."""

from __future__ import annotations

from pathlib import Path

from player.errors import OutputError

_OF_SYSTEMS = {".directory", ".ds_store", "@eadir", "desktop.ini", "thumbs.db"}
"""Names, in small letters, of what KDE, Finder, a Synology server and Explorer put into folders."""
_BESIDE_A_FILE = "._"
"""Prefix of the files in which Finder keeps attributes of others, on disks that hold no attributes."""


def content_of(folder: Path) -> list[Path]:
    """Return what is in a folder, sorted, without what systems have put there; nothing if it is no folder.

    Raises OutputError: the folder cannot be read.

    >>> content_of(Path("surely/not/there"))
    []
    """
    try:
        found = sorted(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise OutputError(f"{folder}: cannot read: {error.strerror or error}") from error
    return [path for path in found if not _is_of_a_system(path.name)]


def has_content(path: Path) -> bool:
    """Return whether there is something else at `path` than an empty file.

    >>> has_content(Path("surely/not/there"))
    False
    """
    return path.exists() and (not path.is_file() or path.stat().st_size > 0)


def _is_of_a_system(name: str) -> bool:
    return name.startswith(_BESIDE_A_FILE) or name.casefold() in _OF_SYSTEMS
