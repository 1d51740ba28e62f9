"""`vfr-export ASSET FILE`: one file for another tool out of a baked asset; the suffix picks the format."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from player.errors import ConfigError, VfrError

FORMATS = {
    ".ply": "binary PLY; colours are sRGB bytes; the axes of the photographs' world (Blender's: Z up)",
    ".obj": "Wavefront OBJ, `v x y z r g b` in sRGB; the same axes",
    ".glb": "binary glTF 2.0; linear COLOR_0, unlit material; turned to Y up: (x, y, z) -> (x, z, -y)",
}

_DESCRIPTION = """\
Write the mesh of a baked asset as one file for another program.

The suffix of FILE picks the format:
  {formats}

Positions are in the units and axes of the world that the cameras of the data set are in, like the asset's
own mesh.ply. Nothing is half written: FILE appears when it is complete and checked.
"""

_EPILOG = """\
examples:
  vfr-export out/ scene.glb             for Blender, Unreal, Unity, three.js
  vfr-export out/ scene.ply --force     for MeshLab, CloudCompare, Open3D; replaces the file
  vfr-export out/ scene.obj --json      and a summary for another program

In Blender: PLY and GLB bring a colour attribute; show it with Viewport Shading > Color > Attribute, render it
with a Color Attribute node.

exit codes: 0 done, 1 an error in one line, 2 wrong usage, 130 interrupted
"""


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    arguments = _parser().parse_args(argv)
    try:
        summary = export_mesh(arguments.asset, arguments.file, arguments.force)
    except VfrError as error:
        print(f"vfr-export: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("vfr-export: interrupted", file=sys.stderr)
        return 130
    if arguments.json:
        print(json.dumps(summary))
    else:
        print(
            f"{summary['file']}: {summary['vertices']} vertices, {summary['faces']} faces, "
            f"{summary['bytes'] / 1e6:.1f} MB, "
            f"bounds {_corner(summary['bounds'][0])} to {_corner(summary['bounds'][1])}"
        )
    return 0


def export_mesh(asset_path: Path, target: Path, force: bool = False) -> dict:
    """Write the mesh of the asset in `asset_path` to `target` and describe it.

    Returns:
        `file`, `format`, `vertices`, `faces`, `bytes`, and `bounds` [2][3] in world units and the asset's own
        (Z up) axes.

    Raises:
        ConfigError: the suffix names no format.
        OutputError: the target exists and `force` is not set, or cannot be written.
        FormatError: the asset or its mesh is damaged.
        ParityError: the bytes do not hold the mesh.
    """
    suffix = target.suffix.lower()
    if suffix not in FORMATS:
        raise ConfigError(f"{target}: suffix: expected one of {', '.join(FORMATS)}, got {suffix or 'none'}")
    from player.files import check_target, write_bytes

    check_target(target, force)
    from exporters.glb import glb_bytes
    from exporters.obj import obj_bytes
    from exporters.parity import check_mesh_bytes
    from exporters.ply import ply_bytes, read_ply
    from player.asset import Asset

    # In the world's frame already: whoever opens mesh.ply itself sees the right place and size too.
    mesh = read_ply(Asset.open(asset_path, verify=True).path("mesh.ply"))
    data = {".ply": ply_bytes, ".obj": obj_bytes, ".glb": glb_bytes}[suffix](mesh)
    check_mesh_bytes(suffix, data, mesh, str(target))
    write_bytes(target, data)
    return {
        "file": str(target),
        "format": suffix[1:],
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "bytes": len(data),
        "bounds": mesh.bounds.tolist() if len(mesh.vertices) else [[0.0] * 3] * 2,
    }


def _parser() -> argparse.ArgumentParser:
    formats = "\n  ".join(f"{suffix}  {text}" for suffix, text in FORMATS.items())
    parser = argparse.ArgumentParser(
        "vfr-export",
        description=_DESCRIPTION.format(formats=formats),
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("asset", type=Path, metavar="ASSET", help="folder that `vfr-bake` wrote")
    parser.add_argument("file", type=Path, metavar="FILE", help="file to write: " + ", ".join(FORMATS))
    parser.add_argument("--force", action="store_true", help="replace FILE if it exists")
    parser.add_argument("--json", action="store_true", help="print the summary as one line of JSON")
    return parser


def _corner(corner: list[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in corner) + ")"


if __name__ == "__main__":
    sys.exit(main())
