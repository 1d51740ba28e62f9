"""Assets of version 3.1 of the format, which is read and no longer written: as its writer wrote them."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import zlib
from pathlib import Path

import numpy as np

from player.asset.asset import Asset
from player.asset.manifest import FileEntry, Manifest, manifest_bytes
from player.asset.pyramid import PyramidValues
from player.asset.single_level import VertexBricks
from player.asset.version_3.unpacking import DENSITIES, FEATURES, PLACES

KEYS_OF_4 = ("level_steps", "density_steps", "feature_steps", "parts")
STRATEGIES = (zlib.Z_HUFFMAN_ONLY, zlib.Z_DEFAULT_STRATEGY)
"""The smaller is kept: differences of codes are noise, in which the repetitions that zlib finds cost more
than they save (lego: 11 % less without them), but for codes that hardly change."""


def pack_codes(codes: np.ndarray) -> bytes:
    """Codes [n] or [n, n_channels], int8 or uint8, as bytes that `unpack_codes` reads."""
    planes = np.ascontiguousarray((codes if codes.ndim == 2 else codes[:, None]).T).view(np.uint8)
    steps = planes.copy()
    steps[:, 1:] -= planes[:, :-1]
    return min((_compressed(steps.tobytes(), strategy) for strategy in STRATEGIES), key=len)


def _compressed(data: bytes, strategy: int) -> bytes:
    stream = zlib.compressobj(strategy=strategy, memLevel=9)
    return stream.compress(data) + stream.flush()


def pack_masks(masks: np.ndarray) -> bytes:
    """Masks of bricks [n_bricks, 8] uint64 as bytes that `unpack_masks` reads."""
    return zlib.compress(np.ascontiguousarray(masks, "<u8").tobytes())


def to_vertices(grid: PyramidValues) -> VertexBricks:
    """Undo `from_vertices`, for a grid of one level; values are [n_vertices, n_channels].

    Every cell with eight corners stored is live in what `from_vertices` makes: a pyramid with a cell that is
    not live among eight vertices of others is another one when it is read again.
    """
    (vertices,), (values,) = grid.pyramid.vertices, grid.values
    return VertexBricks(vertices.bricks.coords, vertices.bricks.masks, values)


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
