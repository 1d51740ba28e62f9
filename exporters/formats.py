"""What `vfr-export` can write, and which settings go with it. No numpy: `vfr-export --help` reads this."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from player.errors import ConfigError

Frame = Literal["world", "model", "gltf", "blender"]

FORMATS = {
    ".ply": "binary PLY; colours are sRGB bytes. With --points N a point cloud instead of a mesh",
    ".obj": "Wavefront OBJ, `v x y z r g b` in sRGB",
    ".glb": "binary glTF 2.0; linear COLOR_0, unlit material; Y up as glTF wants it: (x, y, z) -> (x, z, -y)",
    ".stl": "binary STL: the shape alone, no colours",
    ".usdc": "USD, binary (.usda: text); linear displayColor, metersPerUnit 1, upAxis",
    ".usda": "USD, text",
    ".vdb": "OpenVDB volume: `density`, and with --colour `color` (linear)",
    ".npz": "the same volume as numpy arrays, and what they mean as JSON inside",
    ".json": "transforms.json of the training cameras",
    ".onnx": "the head as an ONNX graph; --decode puts the decode of the features in front",
}
"""Files, by suffix."""

FOLDERS = {
    "exr": "pictures of many layers (colour, depth, position, normals, features), one OpenEXR a camera",
    "colmap": "COLMAP text: the training cameras and a point cloud",
}
"""Folders, by --format."""

COLMAP_FILES = ("cameras.txt", "images.txt", "points3D.txt")

POINTS = 100_000
"""Points of a COLMAP model, unless asked for another number."""

_TAKES = {
    "mesh": {"frame", "crop", "faces"},
    "points": {"frame", "crop", "points"},
    "volume": {"frame", "crop", "colour"},
    "json": {"frame"},
    "colmap": {"frame", "crop", "points"},
    "exr": {"cameras", "views", "size", "half"},
    "onnx": {"decode"},
}


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """The settings of an export; what is None or False has not been asked for."""

    format: str | None = None
    """Of FOLDERS, or a suffix without its dot; None reads it off the target."""
    frame: Frame | None = None
    """None is the world; `exporters.frames` describes them."""
    crop: str | None = None
    """`exporters.crop` reads it."""
    faces: int | None = None
    points: int | None = None
    cameras: Path | None = None
    """A transforms.json; None is the training cameras."""
    views: slice | None = None
    size: tuple[int, int] | None = None
    """Width and height of pictures."""
    half: bool = False
    colour: bool = False
    """Colours in a volume."""
    decode: bool = False
    force: bool = False


def check_options(target: Path, options: ExportOptions) -> str:
    """The name of the format, "ply", ..., "exr", after checking that it takes every setting that is given.

    Raises ConfigError in one line: an unknown suffix or format (with the known ones), a setting that does
    nothing there.

    >>> check_options(Path("scene.GLB"), ExportOptions(faces=1000))
    'glb'
    >>> check_options(Path("head.onnx"), ExportOptions(faces=1000))
    Traceback (most recent call last):
    player.errors.ConfigError: head.onnx: --faces does nothing for onnx; it takes --decode
    """
    name = options.format
    if name is None:
        suffix = target.suffix.lower()
        if suffix not in FORMATS:
            raise ConfigError(
                f"{target}: suffix: expected one of {', '.join(FORMATS)}, or a folder with --format "
                f"{' or '.join(FOLDERS)}, got {suffix or 'none'}"
            )
        name = suffix[1:]
    elif name not in FOLDERS and f".{name}" not in FORMATS:
        known = [*(suffix[1:] for suffix in FORMATS), *FOLDERS]
        raise ConfigError(f"--format: expected one of {', '.join(known)}, got {name}")
    kind = name
    if name in ("ply", "obj", "glb", "stl", "usdc", "usda"):
        kind = "points" if name == "ply" and options.points is not None else "mesh"
    elif name in ("vdb", "npz"):
        kind = "volume"
    default = ExportOptions()
    for key in sorted(set().union(*_TAKES.values()) - _TAKES[kind]):
        if getattr(options, key) != getattr(default, key):
            takes = ", ".join(f"--{option}" for option in sorted(_TAKES[kind]))
            raise ConfigError(f"{target}: --{key} does nothing for {kind_name(name, kind)}; it takes {takes}")
    for key in ("faces", "points"):
        value = getattr(options, key)
        if value is not None and value < 1:
            raise ConfigError(f"--{key}: expected 1 or more, got {value}")
    return name


def kind_name(name: str, kind: str) -> str:
    """How a message calls what is written."""
    return {"points": "a point cloud", "mesh": f"a {name} mesh", "volume": f"a {name} volume"}.get(kind, name)
