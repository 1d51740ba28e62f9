"""NPZ: a volume as plain numpy arrays, for users' own programs. `np.load(file)` reads it; nothing is pickled.

| array | type | meaning |
|---|---|---|
| `index` | int32 [n, 3] | vertices of the grid that have a density |
| `density` | float32 [n] | sigma, 1/unit of the frame |
| `colour` | uint8 [n, 3] | sRGB; only if asked for |
| `matrix` | float64 [4, 4] | place = matrix @ (i, j, k, 1) |
| `info` | text | JSON: `format`, `version`, `frame`, `unit`, `voxel`, `level`, ... |

A dense grid: `grid = np.zeros(index.max(0) + 1, np.float32); grid[tuple(index.T)] = density`.
"""

from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import numpy as np

from exporters.shapes.volume import Volume
from player.errors import FormatError


def npz_bytes(volume: Volume, frame: str) -> bytes:
    """Return the file's content, compressed; the same volume gives the same bytes.

    >>> volume = Volume(np.array([[1, 0, 2]], np.int32), np.ones(1, np.float32), None, np.eye(4))
    >>> parse_npz(npz_bytes(volume, "world"), "a.npz").index.tolist()
    [[1, 0, 2]]
    """
    info = {
        "format": "vfr-volume",
        "version": [1, 0],
        "frame": frame,
        "unit": f"1/{'model' if frame == 'model' else 'world'} unit",
        "voxel": volume.voxel,
        "level": volume.level,
        "interpolate": "log density",
        "colour_space": "srgb",
    }
    text = np.array(json.dumps(info, sort_keys=True))
    arrays: dict[str, Any] = {"index": volume.index, "density": volume.density, "matrix": volume.matrix}
    if volume.colours is not None:
        arrays["colour"] = volume.colours
    file = io.BytesIO()
    np.savez_compressed(file, info=text, **arrays)
    return file.getvalue()


def parse_npz(data: bytes, where: str) -> Volume:
    """Return the volume in a file that `npz_bytes` made; raise FormatError for any other file."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        info = json.loads(str(arrays["info"]))
        colours = arrays.get("colour")
        volume = Volume(arrays["index"], arrays["density"], colours, arrays["matrix"])
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise FormatError(f"{where}: expected a volume as `vfr-export` writes it, got: {error}") from error
    if info.get("format") != "vfr-volume":
        raise FormatError(f"{where}: format: expected vfr-volume, got {info.get('format')!r}")
    return volume
