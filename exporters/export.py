"""From an asset to the file or folder that was asked for: reads, changes, writes, compares.

Meshes are the matter of `exporters.export_mesh`. Everything is made and read back in
memory, or in a folder beside the target, before the target's name appears.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from exporters.export_mesh import export_mesh, mesh_paths, world_mesh
from exporters.options import COLMAP_FILES, FOLDERS, MESHES, POINTS, ExportOptions, check_options
from exporters.shapes.crop import parse_crop
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.asset_surface import Scene
from exporters.surface.inner_region import inner_region
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.transforms import frame_names, read_cameras
from player.cameras.views import asset_cameras
from player.errors import OutputError
from player.files.files import check_target, new_folder, write_bytes

Report = Callable[[str, int, int], object]
"""Called with (stage, done, of)."""


def export_asset(
    asset_path: Path,
    target: Path,
    options: ExportOptions | None = None,
    report: Report | None = None,
) -> dict[str, Any]:
    """Write one file or folder out of the asset in `asset_path` and describe it.

    Args:
        asset_path: the folder of an asset; every checksum is compared.
        target: what to write.
        options: what to write there, and how; by default the mesh, in the world's frame, as the suffix says.
        report: called with (stage, done, of) while something takes its time.

    Returns:
        JSON values: `file`, `format`, `bytes`, and what the format has: `vertices`, `faces`, `bounds` [2][3]
        in WORLD units and axes whatever the frame, `frame`, `removed` (share of the faces that a crop took),
        `faces_asked`, `texture` (its size), `lods` (`file`, `faces`, `bytes` of each), and of a surface that
        was made again `method`, `unseen_faces_removed`, `floaters_removed`, `floater_faces_removed`;
        `voxels`, `densities` (their range) and `level` (half opaque over a voxel), 1/unit of the frame;
        `points`; `cameras`; `pictures`, `channels`; `inputs`, `outputs`.

    Raises:
        ConfigError: an unknown suffix, a setting that does nothing or is out of range, an empty crop, an
            asset that takes more memory than it may.
        OutputError: the target exists and `force` is not set, or cannot be written.
        FormatError: the asset, its mesh or a file of cameras is damaged.
        ParityError: what was written does not hold what was to be written.
        MissingExtraError: the format needs a package that is not installed.
    """
    options = options or ExportOptions()
    report = report or (lambda stage, done, of: None)
    name = check_options(target, options)
    is_mesh = name in MESHES and options.points is None
    for path in [path for level in mesh_paths(target, options, name) for path in level] if is_mesh else []:
        _check_target(asset_path, path, name, options.force)
    force = _check_target(asset_path, target, name, options.force)
    asset = Asset.open(asset_path, verify=True, max_memory=options.max_memory)
    if name not in ("exr", "json", "onnx"):
        asset = inner_region(asset)
    if is_mesh:
        facts = export_mesh(asset, target, options, name, _matrix(asset, options, name), report)
        return {"file": str(target), "format": name, **facts}
    if name == "exr":
        from exporters.pictures import export_pictures

        cameras, names = _views(asset, options)
        return export_pictures(
            asset, target, cameras, names, options.half, force, lambda done, of: report("picture", done, of)
        )
    if name == "colmap":
        return _export_colmap(asset, target, options, force, report)
    if name == "json":
        data, facts = _cameras(asset, target, options)
    elif name == "onnx":
        data, facts = _head(asset, target, options)
    elif name in ("vdb", "npz"):
        data, facts = _volume(asset, target, options, name)
    else:
        data, facts = _points(asset, target, options, report)
    write_bytes(target, data)
    return {"file": str(target), "format": name, **facts, "bytes": len(data)}


def _volume(asset: Asset, target: Path, options: ExportOptions, name: str) -> tuple[bytes, dict[str, Any]]:
    from exporters.formats.npz import npz_bytes
    from exporters.formats.parity import check_volume_bytes
    from exporters.formats.vdb import vdb_bytes
    from exporters.shapes.volume import asset_volume

    frame = options.frame or "world"
    box = None if options.crop is None else parse_crop(options.crop)
    frame_from_world = _matrix(asset, options, name)
    volume, removed = asset_volume(asset, frame_from_world, box, options.colour)
    written = volume.for_blender() if (name, frame) == ("vdb", "blender") else volume
    data = npz_bytes(volume, frame) if name == "npz" else vdb_bytes(written)
    check_volume_bytes(f".{name}", data, written, str(target))
    places = np.c_[volume.points(), np.ones(len(volume.index))] @ np.linalg.inv(frame_from_world).T
    facts = {
        "voxels": len(volume.index),
        "level": volume.level,
        "densities": [float(volume.density.min()), float(volume.density.max())],
        "bounds": [places[:, :3].min(axis=0).tolist(), places[:, :3].max(axis=0).tolist()],
        "frame": frame,
    }
    return data, facts | ({"removed": removed} if options.crop is not None else {})


def _points(
    asset: Asset, target: Path, options: ExportOptions, report: Report
) -> tuple[bytes, dict[str, Any]]:
    from exporters.formats.parity import check_points_bytes
    from exporters.formats.points import points_bytes

    cloud, facts = _cloud(asset, options, options.points or POINTS, report)
    moved = _in_frame(cloud, asset, options, "ply")
    data = points_bytes(moved)
    check_points_bytes(data, moved, str(target))
    return data, {"points": len(cloud.vertices), "bounds": _bounds(cloud), **facts}


def _cameras(asset: Asset, target: Path, options: ExportOptions) -> tuple[bytes, dict[str, Any]]:
    from exporters.formats.transforms import transforms_bytes

    cameras = asset_cameras(asset)
    data = transforms_bytes(cameras, _matrix(asset, options, "json"), str(target))
    return data, {"cameras": len(cameras), "frame": options.frame or "world"}


def _head(asset: Asset, target: Path, options: ExportOptions) -> tuple[bytes, dict[str, Any]]:
    from exporters.head.asset_head import head_bytes

    inputs = ["codes", "weights", "dirs"] if options.decode else ["features", "dirs"]
    return head_bytes(asset, options.decode, str(target)), {"inputs": inputs, "outputs": ["rgb"]}


def _export_colmap(
    asset: Asset, target: Path, options: ExportOptions, force: bool, report: Report
) -> dict[str, Any]:
    from exporters.formats.colmap import colmap_files
    from exporters.formats.transforms import moved_cameras

    cloud, facts = _cloud(asset, options, options.points or POINTS, report)
    cameras = moved_cameras(asset_cameras(asset), _matrix(asset, options, "colmap"))
    files = colmap_files(cameras, _in_frame(cloud, asset, options, "colmap"))
    with new_folder(target, force) as folder:
        for file_name, data in files.items():
            (folder / file_name).write_bytes(data)
    return {
        "file": str(target),
        "format": "colmap",
        "cameras": len(cameras),
        "points": len(cloud.vertices),
        "bounds": _bounds(cloud),
        **facts,
        "bytes": sum(map(len, files.values())),
    }


def _cloud(
    asset: Asset, options: ExportOptions, n_points: int, report: Report
) -> tuple[TriangleMesh, dict[str, Any]]:
    from exporters.formats.points import sample_points

    scene = Scene(asset, report)
    mesh, facts = world_mesh(scene, options)
    return sample_points(scene.painted(mesh) if "method" in facts else mesh, n_points), facts


def _in_frame(mesh: TriangleMesh, asset: Asset, options: ExportOptions, name: str) -> TriangleMesh:
    matrix = _matrix(asset, options, name)
    return mesh if np.array_equal(matrix, np.eye(4)) else mesh.transformed(matrix)


def _matrix(asset: Asset, options: ExportOptions, name: str) -> np.ndarray:
    from exporters.formats.axes import frame_matrix

    return frame_matrix(options.frame or "world", asset.world_from_model, name)


def _views(asset: Asset, options: ExportOptions) -> tuple[list[Camera], list[str]]:
    """The cameras to render, and the names of their files: as `vfr-play` would call them."""
    width, height = asset.manifest.view_size
    given = options.cameras
    cameras = asset_cameras(asset) if given is None else read_cameras(given, (width, height))
    part = options.views or slice(None)
    cameras, names = cameras[part], frame_names(cameras)[part]
    return ([c.resized(*options.size) for c in cameras] if options.size else cameras), names


def _check_target(asset_path: Path, target: Path, name: str, force: bool) -> bool:
    """Refuse a target before any work; returns whether what is there is to be replaced.

    A folder is replaced as a whole, so it must hold nothing but an earlier export of its kind.
    """
    is_folder = name in FOLDERS
    if target.is_dir() and is_folder:
        belongs = {"exr": lambda file: file.endswith(".exr"), "colmap": COLMAP_FILES.__contains__}[name]
        found = sorted(path.name for path in target.iterdir())
        other = [file for file in found if not belongs(file)]
        if other:
            raise OutputError(
                f"{target}: expected no folder, or one of {name} files alone, got {other[0]} in it"
            )
        force = force or not found
    elif target.exists() and target.is_dir() != is_folder:
        wanted, there = ("folder", "file") if is_folder else ("file", "folder")
        raise OutputError(f"{target}: expected the name of a {wanted}, got a {there}")
    if target.exists() and target.resolve().parent == asset_path.resolve():
        raise OutputError(f"{target}: is part of the asset: expected a place outside {asset_path}")
    check_target(target, force)
    return force


def _bounds(mesh: TriangleMesh) -> list[list[float]]:
    return mesh.bounds.tolist() if len(mesh.vertices) else [[0.0] * 3] * 2
