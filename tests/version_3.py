"""Assets of version 3.1 of the format, which is read and no longer written: as its writer wrote them."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from pathlib import Path

import numpy as np

from player.asset.asset import Asset
from player.asset.manifest import FileEntry, Manifest, manifest_bytes
from player.asset.single_level import VertexBricks, to_vertices
from player.asset.version_3.packing import pack_codes, pack_masks
from player.asset.version_3.unpacking import DENSITIES, FEATURES, PLACES

KEYS_OF_4 = ("level_steps", "density_steps", "feature_steps", "parts")


def write_version_3(
    folder: Path, manifest: Manifest, densities: VertexBricks, features: VertexBricks, files: dict[str, bytes]
) -> Path:
    """Write an asset; `files` are head, mesh, cameras and reports by their names. Returns its folder."""
    folder.mkdir(parents=True)
    for names, stored in ((DENSITIES, densities), (FEATURES, features)):
        coords = io.BytesIO()
        np.save(coords, np.ascontiguousarray(stored.coords, "<u2"))
        packed = coords.getvalue(), pack_masks(stored.masks), pack_codes(stored.values)
        files = files | {PLACES[name]: data for name, data in zip(names, packed, strict=True)}
    for name, data in files.items():
        (folder / name).write_bytes(data)
    (folder / "manifest.json").write_bytes(manifest_3(manifest, files))
    return folder


def as_version_3(folder: Path) -> Path:
    """Make the asset in a folder, of one level, one of version 3.1."""
    asset = Asset.open(folder)
    names = (name for name in asset.manifest.files if not name.startswith("part_"))
    files = {name: asset.read(name) for name in names}
    shutil.rmtree(folder)
    stored = (to_vertices(grid) for grid in (asset.arrays.densities, asset.arrays.features))
    return write_version_3(folder, asset.manifest, *stored, files)


def manifest_3(manifest: Manifest, files: dict[str, bytes]) -> bytes:
    """The manifest as version 3.1 has it."""
    document = json.loads(manifest_bytes(manifest))
    for key in KEYS_OF_4:
        del document[key]
    document["n_samples"] = document.pop("n_fetches")
    entries = {name: FileEntry(len(data), hashlib.sha256(data).hexdigest()) for name, data in files.items()}
    document["files"] = {name: vars(entry) for name, entry in entries.items()}
    return json.dumps(document | {"version": [3, 1]}, sort_keys=True, indent=1).encode()
