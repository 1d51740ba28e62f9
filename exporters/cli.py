"""`vfr-export ASSET FILE`: files for other tools out of a baked asset; the suffix picks the format."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from exporters.options import FOLDERS, FORMATS, POINTS, ExportOptions
from player.app.commands import run
from player.app.option_types import gigabytes, number, part, size, whole
from player.app.options import MAX_MEMORY

_DESCRIPTION = """\
Write a baked asset, or a part of it, for another program.

The suffix of FILE picks the format:
  {files}

Two formats are folders, and have to be named:
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

cameras:
  vfr-export out/ cameras.json --frame gltf          transforms.json, turned as the mesh is
  vfr-export out/ sparse/ --format colmap            for Gaussian splatting, MVS

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
with a Color Attribute node. docs/exports.md has the layers of the pictures, and more programs.

exit codes: 0 done, 1 an error in one line, 2 wrong usage, 130 interrupted, 141 unread output
"""


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    return run("vfr-export", lambda: _export(_joined_negatives(sys.argv[1:] if argv is None else argv)))


def _export(argv: list[str]) -> int:
    arguments = make_parser().parse_args(argv)
    from exporters import export  # only now: `--help` needs no numpy

    summary = export.export_asset(arguments.asset, arguments.file, _options(arguments), _bar)
    print(json.dumps(summary) if arguments.json else _sentence(summary))
    return 0


def _options(arguments: argparse.Namespace) -> ExportOptions:
    return ExportOptions(
        format=arguments.format,
        frame=arguments.frame,
        crop=arguments.crop,
        method=arguments.method,
        level=arguments.level,
        faces=arguments.faces,
        lods=arguments.lods,
        texture=arguments.texture,
        time_limit=arguments.time_limit,
        points=arguments.points,
        cameras=arguments.cameras,
        views=arguments.views,
        size=arguments.size,
        half=arguments.half,
        colour=arguments.colour,
        decode=arguments.decode,
        force=arguments.force,
        max_memory=arguments.max_memory,
    )


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
    add("--format", metavar="NAME", help="exr or colmap for a folder; or a suffix without its dot")
    add("--frame", choices=("world", "model", "gltf", "blender"), help="coordinates (world); see below")
    add("--crop", metavar="X,Y,Z,W,D,H[,YAW]", help="only what is in this box of the world; or a .json file")
    add(
        "--faces",
        type=whole(example=100000),
        metavar="N",
        help="simplify the mesh to N faces, or as few as can be reached",
    )
    add(
        "--lods",
        type=whole(example=3),
        metavar="N",
        help="levels of detail: N files, each of half the faces of the last",
    )
    add(
        "--method", choices=("density", "tsdf"), help="make the surface again: marching cubes, or fused depth"
    )
    add(
        "--level",
        type=number("a density", "12.5"),
        metavar="X",
        help="density of the surface, 1/model unit (half opaque: two steps)",
    )
    add(
        "--texture",
        type=whole(example=2048),
        metavar="N",
        help="obj, glb: colours in a picture of N x N (needs xatlas)",
    )
    add(
        "--time-limit",
        type=number("seconds", "300"),
        metavar="S",
        help="seconds that laying out a texture may take (300)",
    )
    add(
        "--points",
        type=whole(example=200000),
        metavar="N",
        help=f"points of a cloud (.ply: no mesh; colmap: {POINTS:,})",
    )
    add("--cameras", type=Path, metavar="FILE", help="views of a transforms.json (the training cameras)")
    add("--views", type=part, metavar="A:B", help="a slice of the views, as in Python")
    add("--size", type=size, metavar="WxH", help="size of the pictures (the cameras' own)")
    add("--half", action="store_true", help="16 bits for colour, normals and features; places stay float")
    add("--colour", action="store_true", help="volume: colours too, of each place seen against its slope")
    add("--decode", action="store_true", help="ONNX: take 8-bit codes and weights instead of features")
    add("--force", action="store_true", help="replace FILE if it exists")
    add("--max-memory", type=gigabytes, metavar="GB", help=MAX_MEMORY)
    add("--json", action="store_true", help="print the summary as one line of JSON")
    return parser


def _joined_negatives(argv: list[str]) -> list[str]:
    """`--crop -1,0,...` as one word: argparse takes what begins with a minus for an option.

    >>> _joined_negatives(["out", "--crop", "-.5,0,0,1,1,1", "a.ply", "--views", "-3:", "--force"])
    ['out', '--crop=-.5,0,0,1,1,1', 'a.ply', '--views=-3:', '--force']
    """
    words = list(argv)
    for index in range(len(words) - 2, -1, -1):
        value = words[index + 1]
        if words[index] in ("--crop", "--views") and value[:1] == "-" and value[1:2] in set(".0123456789"):
            words[index : index + 2] = [f"{words[index]}={value}"]
    return words


def _bar(stage: str, done: int, total: int) -> None:
    """A progress bar on stderr, if that is a terminal."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K[{'#' * (24 * done // total):24}] {stage} {done}/{total}")
        sys.stderr.write("\n" if done == total else "")
        sys.stderr.flush()


def _sentence(summary: dict[str, Any]) -> str:
    names = ("pictures", "cameras", "vertices", "faces", "points", "voxels")
    counts = [f"{summary[name]} {name}" for name in names if name in summary]
    if "channels" in summary:
        counts.append(f"{len(summary['channels'])} channels")
    if "inputs" in summary:
        counts.append(f"{', '.join(summary['inputs'])} -> {', '.join(summary['outputs'])}")
    parts = [*counts, f"{summary['bytes'] / 1e6:.1f} MB"]
    if "bounds" in summary:
        low, high = summary["bounds"]
        parts.append(f"bounds {_corner(low)} to {_corner(high)}")
    if "level" in summary:
        low, high = summary["densities"]
        parts.append(f"densities {low:.3g} to {high:.3g}, half opaque over a voxel at {summary['level']:.4g}")
    if summary.get("frame", "world") != "world":
        parts.append(f"written in the frame {summary['frame']}")
    if summary.get("faces", 0) > summary.get("faces_asked", float("inf")):
        parts.append(f"{summary['faces_asked']} were asked for, but no other edge can go without a fold")
    if "texture" in summary:
        parts.append(f"texture {summary['texture']} x {summary['texture']}")
    for level in summary.get("lods", [])[1:]:
        parts.append(f"{level['file']} of {level['faces']} faces")
    if "method" in summary:
        parts.append(
            f"{summary['unseen_faces_removed']} faces that no training camera sees and "
            f"{summary['floaters_removed']} floating parts ({summary['floater_faces_removed']} faces) removed"
        )
    if "removed" in summary:
        parts.append(
            f"the crop removed {summary['removed']:.1%} of the {'voxels' if 'voxels' in summary else 'faces'}"
        )
    return f"{summary['file']}: {', '.join(parts)}"


def _corner(corner: list[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in corner) + ")"


if __name__ == "__main__":
    sys.exit(main())
