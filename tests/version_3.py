"""Writer of assets in version 3.1 of the format, which is still read but no longer written; it writes the
same bytes as the writer of that time."""

from __future__ import annotations

import io
import json
import shutil
import zlib
from pathlib import Path

import numpy as np

from player.asset.asset import Asset
from player.asset.manifest import Manifest, file_entry, manifest_bytes
from player.asset.pyramid import PyramidValues
from player.asset.single_level import VertexBricks
from player.asset.version_3.unpacking import DENSITIES, FEATURES

KEYS_OF_4 = ("level_steps", "density_steps", "feature_steps", "parts")
STRATEGIES = (zlib.Z_HUFFMAN_ONLY, zlib.Z_DEFAULT_STRATEGY)
"""Strategies of zlib, of which the one with the smaller result is kept. Differences of codes are noise, in
which the repetitions that zlib finds cost more than they save (lego: 11 % less without them), except where
codes hardly change."""


def pack_codes(codes: np.ndarray) -> bytes:
    """Return codes [n] or [n, n_channels], int8 or uint8, as bytes that `unpack_codes` reads."""
    planes = np.ascontiguousarray((codes if codes.ndim == 2 else codes[:, None]).T).view(np.uint8)
    steps = planes.copy()
    steps[:, 1:] -= planes[:, :-1]
    return min((_compressed(steps.tobytes(), strategy) for strategy in STRATEGIES), key=len)


def _compressed(data: bytes, strategy: int) -> bytes:
    stream = zlib.compressobj(strategy=strategy, memLevel=9)
    return stream.compress(data) + stream.flush()


def pack_masks(masks: np.ndarray) -> bytes:
    """Return the masks of bricks [n_bricks, 8] uint64 as bytes that `unpack_masks` reads."""
    return zlib.compress(np.ascontiguousarray(masks, "<u8").tobytes())


def to_vertices(grid: PyramidValues) -> VertexBricks:
    """Undo `from_vertices`, for a grid of one level; values are [n_vertices, n_channels].

    In a grid of `from_vertices` every cell whose eight corners are stored is live. So a pyramid in which such
    a cell is not live, because its corners belong to other cells, is not the same when it is read again.
    """
    (vertices,), (values,) = grid.pyramid.vertices, grid.values
    return VertexBricks(vertices.bricks.coords, vertices.bricks.masks, values)


def write_version_3(
    folder: Path, manifest: Manifest, densities: VertexBricks, features: VertexBricks, files: dict[str, bytes]
) -> Path:
    """Write an asset and return its folder; `files` has head, mesh, cameras and reports by their names."""
    folder.mkdir(parents=True)
    for names, stored in ((DENSITIES, densities), (FEATURES, features)):
        coords = io.BytesIO()
        np.save(coords, np.ascontiguousarray(stored.coords, "<u2"))
        packed = coords.getvalue(), pack_masks(stored.masks), pack_codes(stored.values)
        files = files | dict(zip(names, packed, strict=True))
    for name, data in files.items():
        (folder / name).write_bytes(data)
    (folder / "manifest.json").write_bytes(manifest_3(manifest, files))
    return folder


def as_version_3(folder: Path) -> Path:
    """Rewrite the asset in `folder`, which has one level, in version 3.1."""
    asset = Asset.open(folder)
    names = (name for name in asset.manifest.files if not name.startswith("part_"))
    files = {name: asset.read(name) for name in names}
    shutil.rmtree(folder)
    stored = (to_vertices(grid) for grid in (asset.arrays.densities, asset.arrays.features))
    return write_version_3(folder, asset.manifest, *stored, files)


def manifest_3(manifest: Manifest, files: dict[str, bytes]) -> bytes:
    """Return the manifest as version 3.1 writes it."""
    document = json.loads(manifest_bytes(manifest))
    for key in KEYS_OF_4:
        del document[key]
    document["n_samples"] = document.pop("n_fetches")
    entries = {name: file_entry(data) for name, data in files.items()}
    document["files"] = {name: vars(entry) for name, entry in entries.items()}
    return json.dumps(document | {"version": [3, 1]}, sort_keys=True, indent=1).encode()
