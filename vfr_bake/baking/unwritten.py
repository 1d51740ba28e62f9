"""An asset that plays before it is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from player.asset.asset import Asset, GridArrays
from player.asset.manifest import FileEntry, Manifest


def unwritten_asset(folder: Path, manifest: Manifest, arrays: GridArrays, files: dict[str, bytes]) -> Asset:
    """The asset of `manifest` and `arrays`, which stay in memory.

    Args:
        folder: an empty folder; it must live as long as the asset.
        files: what is opened by its path, by name: `{"head.onnx": ..., "cameras.json": ...}`; only they are
            written.
    """
    for name, data in files.items():
        (folder / name).write_bytes(data)
    entries = {name: FileEntry(len(data), "0" * 64) for name, data in files.items()}
    return Asset(folder, replace(manifest, files=entries), arrays)
