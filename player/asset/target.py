"""Where a new asset may be written: a folder that is replaced is removed as a whole, so it must hold nothing
but an asset."""

from __future__ import annotations

from pathlib import Path

from player.asset.manifest import FORMAT, MAX_BYTES, NAME
from player.errors import FormatError, OutputError
from player.files.content import content_of
from player.files.files import check_target, read_bytes
from player.files.json_files import parse_json


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


def check_asset_target(folder: Path, force: bool = False) -> bool:
    """Raise OutputError, before any work, if an asset cannot be written to `folder`; return whether to
    replace it.

    An empty folder is replaced; with `force`, one that holds an asset and nothing else is replaced, too.

    >>> check_asset_target(Path("surely/not/there"))
    False
    """
    found = content_of(folder)
    force = force or (folder.is_dir() and not found)
    check_target(folder, force)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: expected a folder to write, got a file: name another folder")
    files = asset_files(folder) or set()
    other = [path.name for path in found if path.name not in files]
    if other:
        raise OutputError(
            f"{folder}: expected no folder, or one of an asset alone, got {other[0]} in it: name another "
            f"folder, or move {other[0]} out of it"
        )
    return force
