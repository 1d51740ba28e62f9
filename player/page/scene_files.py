"""The data of a page: the files that its loader asks for.

| file | content |
|---|---|
| `manifest.json` | the asset's manifest as version 4.0, without provenance, and with these `files` |
| `cameras.json` | for each camera its name, width, height, fx, fy, cx, cy and c2w (16 numbers by rows) |
| `head.json`, `head.bin` | the head (`player.page.head_data`) |
| `part_0.bin`, ... | those of the asset's own parts with which it was opened |

The densities and features of an asset of version 3 are written as the parts of a pyramid of one level, which
holds the same values.
"""

from __future__ import annotations

import json
from dataclasses import replace

from player.asset.arranging import write_parts
from player.asset.asset import Asset
from player.asset.manifest import NAME, VERSION, file_entry, manifest_bytes
from player.cameras.views import asset_cameras
from player.errors import FormatError
from player.head.head import asset_head
from player.page.head_data import head_data


def scene_files(asset: Asset) -> dict[str, bytes]:
    """Make the data of a page, in the order in which its files are asked for.

    Raises FormatError: a file of the asset is broken, or a part is missing.

    >>> list(scene_files(Asset.open("out/")))
    ['manifest.json', 'cameras.json', 'head.json', 'head.bin', 'part_0.bin']
    """
    if asset.missing is not None:
        raise FormatError(f"{asset.missing}: a page needs every part")
    manifest = asset.manifest
    head = head_data(asset_head(asset))
    files = {"cameras.json": _cameras(asset), "head.json": head.description, "head.bin": head.numbers}
    if manifest.parts:
        manifest = replace(manifest, parts=manifest.parts[: asset.n_parts])
        files |= {part.file: asset.read(part.file) for part in manifest.parts}
    else:
        stored = asset.arrays
        stored.check(manifest)
        written = write_parts(stored.densities, stored.features, manifest, 0, 0)
        manifest = replace(manifest, parts=tuple(each.part for each in written))
        files |= {each.part.file: each.data for each in written}
    entries = {name: file_entry(data) for name, data in files.items()}
    document = manifest_bytes(replace(manifest, version=VERSION, files=entries, provenance={}))
    compact = json.dumps(json.loads(document), separators=(",", ":")).encode()
    return {NAME: compact, **files}


def _cameras(asset: Asset) -> bytes:
    numbers = ("width", "height", "fx", "fy", "cx", "cy")
    cameras = [
        {
            "name": camera.name,
            **{key: getattr(camera, key) for key in numbers},
            "c2w": camera.c2w.reshape(-1).tolist(),
        }
        for camera in asset_cameras(asset)
    ]
    return json.dumps(cameras, separators=(",", ":")).encode()
