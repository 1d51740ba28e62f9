"""A mesh file, or a few of them, out of an asset: surface, crop, fewer faces, texture, frame, bytes.

Order: the surface as baked or made again, crop (world units), fewer faces, then for each level of detail the
colours, the frame and the bytes. Everything is made and read back in memory, before any name appears.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from exporters.mesh.paint import Texture
from exporters.options import TEXTURE_FACES, ExportOptions
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.asset_surface import Report, Scene
from player.asset.asset import Asset
from player.files.files import write_together

_SECONDS = 300.0
"""Time for the layout of a texture unless asked for another."""


def mesh_paths(target: Path, options: ExportOptions, name: str) -> list[list[Path]]:
    """The files of each level of detail, the finest first; the first of each level is the mesh.

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
    return [[path, path.with_suffix(".mtl"), path.with_suffix(".png")] for path in levels]


def export_mesh(
    asset: Asset, target: Path, options: ExportOptions, name: str, matrix: np.ndarray, report: Report
) -> dict[str, Any]:
    """Write the mesh of an asset, and describe it as `exporters.export.export_asset` says.

    Args:
        asset: an open asset.
        target: the file; with levels of detail, the finest's.
        options: checked for this format.
        name: one of `exporters.options.MESHES`.
        matrix: [4, 4] what takes the world to the frame of the file.
        report: called with (stage, done, of).
    """
    scene = Scene(asset, report)
    mesh, facts = world_mesh(scene, options)
    n_faces = options.faces or (TEXTURE_FACES if options.texture is not None else None)
    if n_faces is not None:
        mesh = _simplified(mesh, n_faces, report)
        facts["faces_asked"] = n_faces
    written: dict[Path, bytes] = {}
    levels = []
    finest = mesh
    for number, paths in enumerate(mesh_paths(target, options, name)):
        if number:
            mesh = _simplified(mesh, max(1, len(mesh.faces) // 2), report)
        is_white = "method" in facts and options.texture is None and name != "stl"
        files = _files(scene, scene.painted(mesh) if is_white else mesh, paths, options, name, matrix)
        written |= files
        levels.append(
            {"file": str(paths[0]), "faces": len(mesh.faces), "bytes": sum(map(len, files.values()))}
        )
    write_together(written)
    if len(levels) > 1:
        facts["lods"] = levels
    if options.texture is not None:
        facts["texture"] = options.texture
    bounds = finest.bounds.tolist() if len(finest.vertices) else [[0.0] * 3] * 2
    counts = {"vertices": len(finest.vertices), "faces": len(finest.faces), "bounds": bounds}
    return {**counts, **facts, "bytes": sum(map(len, written.values()))}


def world_mesh(scene: Scene, options: ExportOptions) -> tuple[TriangleMesh, dict[str, Any]]:
    """The mesh in the world's frame, cropped, and what to say about it: as baked, unless `method` or `level`
    asks for it to be made again: then it is white, and what is said has a `method`."""
    from exporters.formats.ply import parse_ply

    box = None
    if options.crop is not None:
        from exporters.shapes.crop import parse_crop

        box = parse_crop(options.crop)
    facts: dict[str, Any] = {"frame": options.frame or "world"}
    if options.method is None and options.level is None:
        mesh = parse_ply(scene.asset.read("mesh.ply"), str(scene.asset.path("mesh.ply")))
    else:
        method = options.method or "density"
        mesh, removed = scene.surface(method, options.level)
        facts |= {
            "method": method,
            "unseen_faces_removed": removed.unseen,
            "floaters_removed": removed.floaters,
            "floater_faces_removed": removed.floater_faces,
        }
    if box is not None:
        from exporters.shapes.crop import crop_mesh

        mesh, share = crop_mesh(mesh, box)
        facts["removed"] = share
    return mesh, facts


def _simplified(mesh: TriangleMesh, n_faces: int, report: Report) -> TriangleMesh:
    from exporters.mesh.simplify import simplify_mesh

    report("fewer faces", 0, 1)
    mesh = simplify_mesh(mesh, n_faces)
    report("fewer faces", 1, 1)
    return mesh


def _files(
    scene: Scene, mesh: TriangleMesh, paths: list[Path], options: ExportOptions, name: str, matrix: np.ndarray
) -> dict[Path, bytes]:
    """The bytes of one level of detail, compared with what they were written from."""
    from exporters.formats.glb import glb_bytes
    from exporters.formats.obj import obj_bytes, textured_obj_files
    from exporters.formats.parity import check_mesh_bytes, check_textured_glb, check_textured_obj
    from exporters.formats.ply import ply_bytes
    from exporters.formats.stl import stl_bytes

    where = str(paths[0])
    if options.texture is None:
        moved = _moved(mesh, matrix)
        if name in ("usdc", "usda"):
            from exporters.formats.usd import usd_bytes

            data = usd_bytes(moved, f".{name}", "Y" if options.frame == "gltf" else "Z")
        else:
            data = {"ply": ply_bytes, "obj": obj_bytes, "glb": glb_bytes, "stl": stl_bytes}[name](moved)
        check_mesh_bytes(f".{name}", data, moved, where)
        return {paths[0]: data}
    cut, texture = _textured(scene, mesh, options.texture, options.time_limit or _SECONDS)
    moved = _moved(cut, matrix)
    if name == "glb":
        data = glb_bytes(moved, texture)
        check_textured_glb(data, moved, texture, where)
        return {paths[0]: data}
    files = textured_obj_files(moved, texture, paths[0].stem)
    check_textured_obj(files, moved, texture, where)
    # the mesh last: where it is, what it names is there too
    return {paths[1]: files[".mtl"], paths[2]: files[".png"], paths[0]: files[".obj"]}


def _textured(scene: Scene, mesh: TriangleMesh, size: int, seconds: float) -> tuple[TriangleMesh, Texture]:
    from exporters.mesh.paint import paint
    from exporters.mesh.unwrap import unwrap

    report = scene.report
    cut, uvs = unwrap(mesh, size, seconds, lambda done, of: report("layout, seconds of the limit", done, of))
    return cut, paint(cut, uvs, size, scene.coloured)


def _moved(mesh: TriangleMesh, matrix: np.ndarray) -> TriangleMesh:
    return mesh if np.array_equal(matrix, np.eye(4)) else mesh.transformed(matrix)
