"""A page that plays an asset in a browser, as one file or as a folder for a web server."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from player.asset.asset import Asset
from player.asset.manifest import NAME
from player.asset.target import asset_files
from player.errors import ParityError
from player.files.files import new_folder, write_bytes
from player.page.page import INDEX, MAX_GPU_MB, is_site_file, page_of_many_files, page_of_one_file
from player.page.text_bytes import bytes_of_text


def export_page(
    asset: Asset, target: Path, kind: Literal["html", "web"], max_gpu_mb: int | None, force: bool
) -> dict[str, Any]:
    """Write the page that plays an asset, after checking that the page's bytes hold the asset's data.

    Args:
        asset: an open asset with all of its parts.
        target: the file to write, or the folder, which appears once every file is in it.
        kind: "html" for one file, "web" for a folder.
        max_gpu_mb: megabytes of graphics memory that the page may take; MAX_GPU_MB if None.
        force: replace a folder that exists.

    Returns:
        `bytes`, `viewer_bytes` and `gpu_bytes`, described in `exporters.export.export_asset`.

    Raises:
        ConfigError: the page needs more graphics memory than it may take, or more memory or channels than
            browsers have.
        FormatError: a file of the asset is broken.
        OutputError: the target cannot be written.
        ParityError: the bytes that were to be written do not hold the asset's data.
    """
    make = page_of_one_file if kind == "html" else page_of_many_files
    made = make(asset, max_gpu_mb=max_gpu_mb or MAX_GPU_MB)
    _check_data(files_in_page(made.files[INDEX]) if kind == "html" else made.files, str(target))
    if kind == "html":
        write_bytes(target, made.files[INDEX])
    else:
        with new_folder(target, force) as folder:
            for name, data in made.files.items():
                (folder / name).write_bytes(data)
    n_bytes = sum(map(len, made.files.values()))
    return {"bytes": n_bytes, "viewer_bytes": made.viewer_bytes, "gpu_bytes": made.gpu_bytes}


def page_files(folder: Path) -> Callable[[Path], bool]:
    """Return the function that tells whether a file in `folder` is one of a page for a web server: it has the
    name of such a file, and the manifest of a scene is beside it."""
    has_scene = asset_files(folder) is not None
    return lambda path: has_scene and is_site_file(path.name)


def files_in_page(page: bytes) -> dict[str, bytes]:
    """Return the scene's files that a one-file page contains, by name. Zeros may follow a file's content.

    Raises ParityError: the text of a file cannot be decoded into bytes.
    """
    found = {}
    for name, text in re.findall(rb'<script[^>]* data-file="([^"]*)"[^>]*>([^<]*)</script>', page):
        try:
            found[name.decode()] = text if name.decode() == NAME else bytes_of_text(text)
        except ValueError as error:
            raise ParityError(f"{name.decode()}: {error}") from error
    return found


def _check_data(files: dict[str, bytes], where: str) -> None:
    """Raise ParityError unless every file of the scene has the SHA-256 that the scene's manifest gives."""
    for name, entry in json.loads(files[NAME])["files"].items():
        digest = hashlib.sha256(files.get(name, b"")[: entry["bytes"]]).hexdigest()
        if digest != entry["sha256"]:
            raise ParityError(f"{where}: {name}: expected sha256 {entry['sha256']}, read back {digest}")
