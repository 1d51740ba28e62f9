"""Export of an asset's mesh, as one file or several.

Steps: take the baked surface or make it again, crop it (in world units), reduce its faces; then, for each
level of detail, find the colours, change the coordinates and encode the bytes. Everything is made and read
back in memory before any file gets its name.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from exporters.extras import require_open3d
from exporters.formats import glb, obj, ply, stl, usd
from exporters.formats.parity import check_mesh_bytes, check_steps, check_textured_obj
from exporters.mesh.paint import paint
from exporters.mesh.simplify import simplify_mesh
from exporters.mesh.unwrap import require_xatlas, unwrap
from exporters.options import TEXTURE_FACES, ExportOptions
from exporters.shapes.crop import crop_mesh, parse_crop
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.asset_surface import AssetSurface
from exporters.surface.depth_views import FEW_PIXELS, SMALL_PIXELS
from exporters.surface.few_faces import few_faces
from player.asset.asset import Asset
from player.errors import ConfigError, DataError
from player.files.files import write_together
from player.progress import Report

_SECONDS = 300.0
"""Seconds that the layout of a texture may take unless another limit is asked for."""
NEARER = "add --frame model, whose coordinates are small"
"""The hint for a mesh that is too far from the origin."""


def mesh_paths(target: Path, options: ExportOptions, name: str) -> list[list[Path]]:
    """Return the files of each level of detail, the finest level first; a level's first file is the mesh.

    Raises ConfigError: two files would have the same name, because the target's suffix is not its format's,
    or the name has spaces, which an MTL file cannot quote.

    >>> [[path.name for path in level] for level in mesh_paths(Path("a.glb"), ExportOptions(lods=3), "glb")]
    [['a.glb'], ['a.lod1.glb'], ['a.lod2.glb']]
    >>> [path.name for path in mesh_paths(Path("a.obj"), ExportOptions(texture=64), "obj")[0]]
    ['a.obj', 'a.mtl', 'a.png']
    """
    levels = [target]
    for number in range(1, options.lods or 1):
        levels.append(target.with_name(f"{target.stem}.lod{number}{target.suffix}"))
    if options.texture is None or name != "obj":
        return [[path] for path in levels]
    obj.check_stem(target.stem)
    found = [[path, path.with_suffix(".mtl"), path.with_suffix(".png")] for path in levels]
    if len({str(path).lower() for paths in found for path in paths}) < 3 * len(found):
        raise ConfigError(
            f"{target}: name: expected another than those of the MTL and the PNG beside the OBJ, got "
            f"{target.name}: end it in .obj"
        )
    return found


def check_packages(options: ExportOptions, name: str) -> None:
    """Raise MissingExtraError if a package that only the last steps of a mesh or of points need is not
    installed, so that nobody waits for these in vain. `name` is that of the format.

    Whether a mesh with a texture needs Open3D is known only when its surface is made: it may have few faces.
    """
    asked = {"--faces": options.faces, "--lods": options.lods, "--method tsdf": options.method == "tsdf"}
    for option, value in asked.items():
        if value:
            require_open3d(option)
    if options.texture is not None:
        require_xatlas()
    if name in ("usdc", "usda"):
        usd.load_usd()


def export_mesh(
    asset: Asset, target: Path, options: ExportOptions, name: str, matrix: np.ndarray, report: Report
) -> dict[str, Any]:
    """Write the mesh of an asset, and return its description as `exporters.export.export_asset` documents it.

    Args:
        asset: an open asset.
        target: the file to write; with levels of detail, that of the finest level.
        options: the settings, already checked for this format.
        name: one of `exporters.options.MESHES`.
        matrix: [4, 4] transform from the world to the coordinates of the file.
        report: called with (stage, done, of).

    Raises ConfigError: the mesh is so far from the origin that float32 would deform it.
    """
    is_few = options.method is None and options.level is None and options.texture is None
    surface = AssetSurface(asset, report, FEW_PIXELS if is_few else SMALL_PIXELS)
    finest, facts = world_mesh(surface, options)
    n_faces = options.faces or (TEXTURE_FACES if options.texture is not None else None)
    if n_faces is not None:
        finest = _simplified(finest, n_faces, report)
        facts["faces_asked"] = n_faces
    if name != "obj":  # its decimals follow the mesh's extent
        check_steps(finest.transformed(matrix), str(target), NEARER)
    is_white = "method" in facts and options.texture is None and name != "stl"
    written: dict[Path, bytes] = {}
    levels = []
    mesh = finest
    for number, paths in enumerate(mesh_paths(target, options, name)):
        if number:
            mesh = _simplified(mesh, max(1, len(mesh.faces) // 2), report)
        painted = surface.painted(mesh) if is_white else mesh
        files, n_vertices = _files(surface, painted, paths, options, name, matrix)
        written |= files
        n_bytes = sum(map(len, files.values()))
        levels.append(
            {"file": str(paths[0]), "vertices": n_vertices, "faces": len(mesh.faces), "bytes": n_bytes}
        )
    write_together(written)
    if len(levels) > 1:
        facts["lods"] = levels
    if options.texture is not None:
        facts["texture"] = options.texture
    counts = {"vertices": levels[0]["vertices"], "faces": len(finest.faces), "bounds": bounds_of(finest)}
    return {**counts, **facts, "bytes": sum(map(len, written.values()))}


def world_mesh(surface: AssetSurface, options: ExportOptions) -> tuple[TriangleMesh, dict[str, Any]]:
    """Return the mesh in the world's coordinates, cropped, and facts about it for the summary.

    The `method` "baked" takes the mesh that is stored in the asset. All others make the mesh again:
    it is then white, and the facts include the `method`. By default it has about the faces of a
    grid of `exporters.surface.few_faces.RESOLUTION` voxels along the box; with a method or a level
    it keeps all of its faces.

    Raises:
        ConfigError: the stored mesh, which is in float32, is too far from the origin.
        DataError: the asset holds no mesh.
    """
    box = None if options.crop is None else parse_crop(options.crop)
    facts: dict[str, Any] = {"frame": options.coordinates}
    if options.method == "baked":
        where = str(surface.asset.path("mesh.ply"))
        mesh = ply.parse_ply(surface.asset.read("mesh.ply"), where)
        if not len(mesh.faces):
            raise DataError(f"{where}: faces: expected a mesh, got none: leave out --method baked")
        check_steps(mesh, where, "make the surface again, without --method baked")
    else:
        if options.method == "tsdf":
            mesh, removed = surface.from_depth()
        elif options.method is None and options.level is None:
            mesh, removed = few_faces(surface)
        else:
            mesh, removed = surface.from_density(options.level)
        facts["method"] = options.method or "density"
        facts |= {f"{what}_removed": count for what, count in removed._asdict().items()}
    if box is not None:
        mesh, facts["removed"] = crop_mesh(mesh, box)
    return mesh, facts


def bounds_of(mesh: TriangleMesh) -> list[list[float]]:
    """Return the smallest and largest coordinates, [2][3]; 0 without vertices, because JSON has no NaN."""
    return np.nan_to_num(mesh.bounds).tolist()


def _simplified(mesh: TriangleMesh, n_faces: int, report: Report) -> TriangleMesh:
    report("fewer faces", 0, 1)
    mesh = simplify_mesh(mesh, n_faces)
    report("fewer faces", 1, 1)
    return mesh


def _files(
    surface: AssetSurface,
    mesh: TriangleMesh,
    paths: list[Path],
    options: ExportOptions,
    name: str,
    matrix: np.ndarray,
) -> tuple[dict[Path, bytes], int]:
    """Return the bytes of the files of one level of detail, after comparing them with the mesh they hold, and
    its number of vertices: a texture has those on its seams once for each side."""
    where, texture = str(paths[0]), None
    if options.texture is not None:
        seconds = options.time_limit or _SECONDS
        layout = partial(surface.report, "layout, seconds of the limit")
        mesh, uvs = unwrap(mesh, options.texture, seconds, layout)
        colours = partial(surface.report, "colours")
        texture = paint(mesh, uvs, options.texture, surface.shaded, colours)
    mesh = mesh.transformed(matrix)
    if texture is not None and name == "obj":
        files = obj.textured_obj_files(mesh, texture, paths[0].stem)
        check_textured_obj(files, mesh, texture, where)
        # the OBJ is written last, so that where it exists the files that it names exist too
        made = {paths[1]: files[".mtl"], paths[2]: files[".png"], paths[0]: files[".obj"]}
        return made, len(mesh.vertices)
    if name == "glb":
        data = glb.glb_bytes(mesh, texture)
    elif name in ("usdc", "usda"):
        data = usd.usd_bytes(mesh, f".{name}", "Y" if options.frame == "gltf" else "Z")
    else:
        data = {"ply": ply.ply_bytes, "obj": obj.obj_bytes, "stl": stl.stl_bytes}[name](mesh)
    check_mesh_bytes(f".{name}", data, mesh, where, texture)
    return {paths[0]: data}, len(mesh.vertices)
