"""The command `vfr-export ASSET FILE`: writes a baked asset for other tools; the suffix picks the format."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, get_args

from exporters.options import FOLDERS, FORMATS, POINTS, Coordinates, ExportOptions, Method
from player.app.commands import run
from player.app.option_types import gigabytes, joined_negatives, number, part, size, whole
from player.progress import Bars

_DESCRIPTION = """\
Write a baked asset, or a part of it, for another program.

The suffix of FILE picks the format:
  {files}

Some formats are folders, and have to be named:
  {folders}

Places are in the world that the cameras of the data set are in, with its unit, unless --frame says otherwise.
What is written is read back and compared before its name appears: nothing is half written.
"""

_EPILOG = """\
meshes and points:
  vfr-export out/ scene.glb                          for Blender, Unreal, Unity, three.js
  vfr-export out/ scene.obj --frame blender          Y up, as Blender's OBJ importer expects
  vfr-export out/ scene.ply --faces 100000           fewer faces, colours kept
  vfr-export out/ scene.glb --lods 3                 scene.glb, scene.lod1.glb, scene.lod2.glb: half the faces
  vfr-export out/ scene.glb --texture 2048           colours in a picture, 200,000 faces unless --faces
  vfr-export out/ fine.ply --method density          the surface again, from the density as it is stored
  vfr-export out/ fused.ply --method tsdf            the surface again, from what the training cameras see
  vfr-export out/ part.stl --crop 0,0,0.5,1,1,1      a box of 1 x 1 x 1 around (0, 0, 0.5)
  vfr-export out/ part.stl --crop 0,0,0.5,2,1,1,30   the same, 2 long, turned by 30 degrees about Z
  vfr-export out/ part.stl --crop box.json           {"matrix": 4 x 4 world from box, "size": [W, D, H]}
  vfr-export out/ points.ply --points 200000         a point cloud with normals and colours

  vfr-export out/ scene.usdc                         for Omniverse, Houdini, Unreal

volumes:
  vfr-export out/ scene.vdb --colour                 for Houdini and others: density and linear colour
  vfr-export out/ scene.vdb --frame blender          for Blender's renderer
  vfr-export out/ scene.npz                          the same as numpy arrays

pages:
  vfr-export out/ scene.html                         one file that plays in any browser: open it, mail it
  vfr-export out/ site/ --format web                 the same for a web server: shows something sooner

cameras:
  vfr-export out/ cameras.json --frame gltf          transforms.json, turned as the mesh is
  vfr-export out/ sparse/ --format colmap            for Gaussian splatting

pictures:
  vfr-export out/ frames/ --format exr --cameras transforms_test.json
  vfr-export out/ frames/ --format exr --views 0:10 --size 800x600 --half

the head:
  vfr-export out/ head.onnx                          features, dirs -> rgb
  vfr-export out/ head.onnx --decode                 codes, weights, dirs -> rgb

frames of --frame:
  world    the photographs' (GLB files are turned to Y up in every frame, because glTF is)
  model    the field's own, its box is -1..1
  gltf     the world turned to Y up: (x, y, z) -> (x, z, -y)
  blender  so that Blender's importers, left as they are, show the world: OBJ and GLB Y up, others Z up,
           VDB half a voxel lower, which is where Blender's renderer then draws it

In Blender: PLY and GLB bring a colour attribute; show it with Viewport Shading > Color > Attribute, render it
with a Color Attribute node. docs/export.md has the layers of the pictures, and more programs.

exit codes: 0 done, 1 an error in one line, 2 wrong usage, 130 interrupted, 141 unread output
"""


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    words = joined_negatives(sys.argv[1:] if argv is None else argv, "--crop", "--views")
    return run("vfr-export", lambda: _export(words))


def _export(argv: list[str]) -> int:
    arguments = make_parser().parse_args(argv)
    from exporters import export  # imported late, because `--help` needs no numpy

    with Bars() as bars:
        summary = export.export_asset(arguments.asset, arguments.file, _options(arguments), bars.count)
    print(json.dumps(summary) if arguments.json else _sentence(summary))
    return 0


def _options(arguments: argparse.Namespace) -> ExportOptions:
    return ExportOptions(**{field.name: getattr(arguments, field.name) for field in fields(ExportOptions)})


def make_parser() -> argparse.ArgumentParser:
    def table(rows: dict[str, str]) -> str:
        return "\n  ".join(f"{name:8}{text}" for name, text in rows.items())

    parser = argparse.ArgumentParser(
        "vfr-export",
        description=_DESCRIPTION.format(files=table(FORMATS), folders=table(FOLDERS)),
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("asset", type=Path, metavar="ASSET", help="folder that `vfr-bake` wrote")
    add("file", type=Path, metavar="FILE", help="file or folder to write: " + ", ".join(FORMATS) + ", DIR/")
    _value(parser, "--format", "NAME", "exr, colmap or web for a folder; or a suffix without its dot")
    add("--frame", choices=get_args(Coordinates), help="coordinates (world); see below")
    add("--force", action="store_true", help="replace FILE if it exists")
    memory = "gigabytes of memory that the asset may take, or a picture of EXR (half of the machine's)"
    _value(parser, "--max-memory", "GB", memory, type=gigabytes)
    add("--json", action="store_true", help="print the summary as one line of JSON")
    _add_shapes(parser.add_argument_group("meshes, points and volumes"))
    _add_pictures(parser.add_argument_group("pictures and cameras"))
    add = parser.add_argument_group("the head").add_argument
    add("--decode", action="store_true", help="take 8-bit codes and weights instead of features")
    pages = parser.add_argument_group("pages")
    most = "megabytes of graphics memory that a page may take (512)"
    _value(pages, "--max-gpu-mb", "N", most, type=whole(example=256))
    return parser


def _value(group: argparse._ActionsContainer, name: str, metavar: str, text: str, **kind: Any) -> None:
    group.add_argument(name, metavar=metavar, help=text, **kind)


def _add_shapes(group: argparse._ArgumentGroup) -> None:
    value, add = partial(_value, group), group.add_argument
    value("--crop", "X,Y,Z,W,D,H[,YAW]", "only what is in this box of the world; or a .json file")
    faces, lods, texels, cloud = (whole(example=n) for n in (100000, 3, 2048, 200000))
    value("--faces", "N", "simplify the mesh to at most N faces", type=faces)
    value("--lods", "N", "levels of detail: N files, each of half the faces of the last", type=lods)
    add(
        "--method", choices=get_args(Method), help="the baked mesh; marching cubes in all voxels; fused depth"
    )
    density, seconds = number("a density", "12.5"), number("seconds", "300")
    level = "density at which the surface lies, 1/model unit (the one that absorbs half of the light over "
    level += "two voxels or two march steps, whichever are longer)"
    value("--level", "X", level, type=density)
    value("--texture", "N", "obj, glb: colours in a picture of N x N (needs xatlas)", type=texels)
    value("--time-limit", "S", "seconds that laying out a texture may take (300)", type=seconds)
    value("--points", "N", f"points of a cloud (.ply: no mesh; colmap: {POINTS:,})", type=cloud)
    colour = "volume: also the colour of each vertex, seen along the density's gradient"
    add("--colour", action="store_true", help=colour)


def _add_pictures(group: argparse._ArgumentGroup) -> None:
    value = partial(_value, group)
    views = "views of a transforms.json, camera_path.json or COLMAP model (the training cameras)"
    value("--cameras", "FILE", views, type=Path)
    value("--views", "A:B", "only these of the views, as a slice in Python", type=part)
    value("--size", "WxH", "size of the pictures (the cameras' own)", type=size)
    half = "16 bits for colour, normals and features; places stay float"
    group.add_argument("--half", action="store_true", help=half)


def _sentence(summary: dict[str, Any]) -> str:
    from exporters.shapes.crop import corners_text  # imported late, because `--help` needs no numpy

    names = ("pictures", "cameras", "vertices", "faces", "points", "voxels")
    counts = [f"{summary[name]} {name}" for name in names if name in summary]
    if "channels" in summary:
        counts.append(f"{len(summary['channels'])} channels")
    if "inputs" in summary:
        counts.append(f"{', '.join(summary['inputs'])} -> {', '.join(summary['outputs'])}")
    parts = [*counts, f"{summary['bytes'] / 1e6:.1f} MB"]
    parts += summary.get("notes", [])
    if "viewer_bytes" in summary:
        parts.append(f"{summary['viewer_bytes'] / 1e3:.0f} kB of it the viewer")
        parts.append(f"{-(-summary['gpu_bytes'] // 10**6)} MB of graphics memory")
    if "bounds" in summary:
        parts.append(f"bounds {corners_text(summary['bounds'])}")
    if "level" in summary:
        low, high = summary["densities"]
        parts.append(f"densities {low:.3g} to {high:.3g}, half opaque over a voxel at {summary['level']:.4g}")
    if summary.get("frame", "world") != "world":
        parts.append(f"written in the frame {summary['frame']}")
    if summary.get("faces", 0) > summary.get("faces_asked", float("inf")):
        parts.append(f"{summary['faces_asked']} were asked for, but fewer would leave nothing of the shape")
    if "texture" in summary:
        parts.append(f"texture {summary['texture']} x {summary['texture']}")
    for level in summary.get("lods", [])[1:]:
        parts.append(f"{level['file']} of {level['faces']} faces")
    if "method" in summary:
        parts.append(
            f"{summary['unseen_faces_removed']} faces that no training camera sees, "
            f"{summary['haze_faces_removed']} of haze and "
            f"{summary['floaters_removed']} floating parts ({summary['floater_faces_removed']} faces) removed"
        )
    if "removed" in summary:
        parts.append(
            f"the crop removed {summary['removed']:.1%} of the {'voxels' if 'voxels' in summary else 'faces'}"
        )
    return f"{summary['file']}: {', '.join(parts)}"


if __name__ == "__main__":
    sys.exit(main())
