"""Where a new asset may be written: a folder that is replaced is removed as a whole, so it must hold nothing
but an asset."""

from __future__ import annotations

from pathlib import Path

from player.asset.manifest import FORMAT, MAX_BYTES, NAME
from player.errors import FormatError, OutputError
from player.files.files import check_target, read_bytes
from player.files.json_files import parse_json

_OF_SYSTEMS = {".DS_Store", "Thumbs.db", "desktop.ini"}
"""Files that Finder and Explorer leave in folders that were looked at."""


def asset_files(folder: Path) -> set[str] | None:
    """Return the names of the files of the asset in `folder`, of whatever version and complete or not; None
    if there is no asset.

    >>> asset_files(Path("surely/not/there")) is None
    True
    """
    path = folder / NAME
    try:
        document = parse_json(read_bytes(path, "a manifest", MAX_BYTES), str(path))
    except FormatError:
        return None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        return None
    listed = document.get("files")
    return {NAME, *listed} if isinstance(listed, dict) else {NAME}


def check_asset_target(folder: Path, force: bool = False) -> None:
    """Raise OutputError, before any work, if an asset cannot be written to `folder`.

    With `force`, a folder is replaced if it holds an asset and nothing else, or nothing at all.

    >>> check_asset_target(Path("surely/not/there"))
    """
    check_target(folder, force)
    if not folder.exists():
        return
    if not folder.is_dir():
        raise OutputError(f"{folder}: expected a folder to write, got a file: name another folder")
    files = asset_files(folder) or set()
    other = sorted({path.name for path in folder.iterdir()} - files - _OF_SYSTEMS)
    if other:
        raise OutputError(
            f"{folder}: expected no folder, or one of an asset alone, got {other[0]} in it: name another"
        )
