"""A page that plays an asset in a browser, as one file or as a folder for a web server."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any, Literal

from player.asset.asset import Asset
from player.errors import ParityError
from player.files.files import new_folder, write_bytes
from player.page.page import INDEX, MAX_GPU_MB, page_of_many_files, page_of_one_file
from player.page.scene_files import MANIFEST
from player.page.text_bytes import bytes_of_text


def export_page(
    asset: Asset, target: Path, kind: Literal["html", "web"], max_gpu_mb: int | None, force: bool
) -> dict[str, Any]:
    """Write the page of an asset, after reading its data back.

    Args:
        asset: an open asset, all of its parts.
        target: the file, or the folder, which appears when every file is in it.
        kind: "html" for a file, "web" for a folder.
        max_gpu_mb: megabytes of graphics memory that it may take; MAX_GPU_MB if None.
        force: replace a folder that exists.

    Returns:
        `bytes`, `viewer_bytes`, `gpu_bytes`, for `exporters.export.export_asset`.

    Raises:
        ConfigError: more graphics memory than it may take, or more channels than browsers can draw.
        FormatError: a file of the asset is broken.
        OutputError: the target cannot be written.
        ParityError: what was to be written does not hold the asset's data.
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


def files_in_page(page: bytes) -> dict[str, bytes]:
    """The files of the scene that a page of one file holds; zeros may follow what counts.

    Raises ParityError: text that stands for no bytes.
    """
    found = {}
    for name, text in re.findall(rb'<script type="text/plain" data-file="([^"]*)">([^<]*)</script>', page):
        try:
            found[name.decode()] = text if name.decode() == MANIFEST else bytes_of_text(text)
        except ValueError as error:
            raise ParityError(f"{name.decode()}: {error}") from error
    return found


def _check_data(files: dict[str, bytes], where: str) -> None:
    """Raise ParityError unless every file of the scene is the one that its manifest names."""
    for name, entry in json.loads(files[MANIFEST])["files"].items():
        digest = hashlib.sha256(files.get(name, b"")[: entry["bytes"]]).hexdigest()
        if digest != entry["sha256"]:
            raise ParityError(f"{where}: {name}: expected sha256 {entry['sha256']}, read back {digest}")
