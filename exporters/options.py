"""Formats and settings of `vfr-export`, and the settings that each format takes. Imports no numpy, because
`vfr-export --help` reads this module."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from player.errors import ConfigError

Coordinates = Literal["world", "model", "gltf", "blender"]
Method = Literal["baked", "density", "tsdf"]

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
    ".html": "a page that plays the scene in any browser with WebGL2: one file, no server",
    ".onnx": "the head as an ONNX graph; --decode puts the decode of the features in front",
}
"""Descriptions of the file formats, by suffix."""

FOLDERS = {
    "exr": "pictures of many layers (colour, depth, position, normals, features), one OpenEXR a camera",
    "colmap": "COLMAP model: the training cameras and a point cloud",
    "web": "the page as files for a web server, which shows something before all of it is there",
}
"""Descriptions of the formats that are folders, by the name that --format takes."""

MESHES = ("ply", "obj", "glb", "stl", "usdc", "usda")
"""Names of the formats that hold a mesh."""

POINTS = 100_000
"""Points of a COLMAP model, unless another number is asked for."""

MAX_POINTS = 10_000_000
"""The most points of a cloud or a model: they take a few gigabytes of memory while they are made."""

MAX_TEXTURE = 8192
"""The most texels along each side of a texture: Pillow, with which the written picture is read back, refuses
one of twice as many."""

TEXTURE_FACES = 200_000
"""Faces of a mesh with a texture, unless another number is asked for: laying out more takes minutes."""

_SURFACE = {"frame", "crop", "method", "level"}
_MESH = _SURFACE | {"faces", "lods"}
_TAKES = {
    "mesh": _MESH,
    "textured": _MESH | {"texture", "time_limit"},
    "points": _SURFACE | {"points"},
    "volume": {"frame", "crop", "colour"},
    "json": {"frame"},
    "colmap": _SURFACE | {"points"},
    "exr": {"cameras", "views", "size", "half"},
    "onnx": {"decode"},
    "html": {"max_gpu_mb"},
    "web": {"max_gpu_mb"},
}


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """The settings of an export; what is None or False has not been asked for."""

    format: str | None = None
    """A name in FOLDERS, or a suffix without its dot; None reads it off the target."""
    frame: Coordinates | None = None
    """The coordinates of what is written, described in `exporters.formats.axes`; None is the world's."""
    crop: str | None = None
    """The box to keep, as `exporters.shapes.crop` reads it; None keeps all."""
    method: Method | None = None
    """Where the surface is from: the asset's own small mesh, marching cubes on the density in all its voxels,
    or fused depth; None is marching cubes in fewer faces."""
    level: float | None = None
    """Density of the surface, 1/model unit; given, the surface is made again."""
    faces: int | None = None
    """The most faces of the mesh; None keeps them."""
    lods: int | None = None
    """Levels of detail, each a file with half the faces of the one before; None is one."""
    texture: int | None = None
    """Texels along each side of a picture, in place of vertex colours."""
    time_limit: float | None = None
    """Seconds that laying out a texture may take."""
    points: int | None = None
    """Points of a cloud."""
    cameras: Path | None = None
    """Views of the pictures: a transforms.json, nerfstudio's camera_path.json or a COLMAP model; None is the
    training cameras."""
    views: slice | None = None
    """The views to take; None is all."""
    size: tuple[int, int] | None = None
    """Width and height of pictures; None is each camera's own."""
    half: bool = False
    """16 bits for the colours, normals and features of pictures."""
    colour: bool = False
    """Colours in a volume."""
    decode: bool = False
    """The head takes codes and weights instead of features."""
    max_gpu_mb: int | None = None
    """Megabytes of graphics memory that a page may take; None is `player.page.page.MAX_GPU_MB`."""
    force: bool = False
    """Replace what is there."""
    max_memory: float | None = None
    """Gigabytes that the asset may take, or a picture of EXR; a share of the machine's if None."""

    @property
    def coordinates(self) -> Coordinates:
        """The coordinates of what is written, the world's unless others are asked for."""
        return self.frame or "world"


def check_options(target: Path, options: ExportOptions) -> str:
    """Return the name of the format, "ply", ..., "exr", after checking that it takes
    every setting that is given.

    Raises ConfigError with one line: the suffix or format is unknown (the line lists the known ones), or a
    setting does nothing for the format or is out of range.

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
                f"exr, colmap or web, got {suffix or 'none'}"
            )
        name = suffix[1:]
    elif name not in FOLDERS and f".{name}" not in FORMATS:
        known = [*(suffix[1:] for suffix in FORMATS), *FOLDERS]
        raise ConfigError(f"--format: expected one of {', '.join(known)}, got {name}")
    kind = _kind(name, options)
    default = ExportOptions()
    for key in sorted(set().union(*_TAKES.values()) - _TAKES[kind]):
        if getattr(options, key) != getattr(default, key):
            takes = ", ".join(_flag(option) for option in sorted(_TAKES[kind]))
            raise ConfigError(
                f"{target}: {_flag(key)} does nothing for {kind_name(name, kind)}; it takes {takes}"
            )
    _check_ranges(options)
    return name


def _kind(name: str, options: ExportOptions) -> str:
    if name == "ply" and options.points is not None:
        return "points"
    if name in MESHES:
        return "textured" if name in ("obj", "glb") else "mesh"
    return "volume" if name in ("vdb", "npz") else name


def _flag(key: str) -> str:
    return f"--{key.replace('_', '-')}"


def _check_ranges(options: ExportOptions) -> None:
    if options.method is not None and options.method not in get_args(Method):
        raise ConfigError(f"--method: expected one of {', '.join(get_args(Method))}, got {options.method}")
    for key, low, high in (
        ("faces", 1, None),
        ("points", 1, MAX_POINTS),
        ("lods", 2, 10),
        ("texture", 16, MAX_TEXTURE),
        ("max_gpu_mb", 1, None),
    ):
        value = getattr(options, key)
        if value is not None and (value < low or (high is not None and value > high)):
            wanted = f"{low} or more" if high is None else f"{low} to {high}"
            raise ConfigError(f"{_flag(key)}: expected {wanted}, got {value}")
    if options.time_limit is not None and not options.time_limit > 0:
        raise ConfigError(f"--time-limit: expected seconds > 0, got {options.time_limit:g}")
    if options.time_limit is not None and options.texture is None:
        raise ConfigError("--time-limit: expected it with --texture, got it alone")
    if options.level is not None and options.method not in (None, "density"):
        raise ConfigError(f"--level: expected --method density, got {options.method}, which has no level")


def kind_name(name: str, kind: str) -> str:
    """Return the words by which an error message calls what is written."""
    mesh, volume = f"a {name} mesh", f"a {name} volume"
    return {"points": "a point cloud", "mesh": mesh, "textured": mesh, "volume": volume}.get(kind, name)
