"""Export of an asset to the file or folder that was asked for.

Meshes are exported by `exporters.export_mesh`, pictures by `exporters.pictures` and pages by
`exporters.pages`. Everything is made and read back in memory, or in a folder beside the target, before the
target's name appears.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from exporters.export_mesh import NEARER, bounds_of, check_packages, export_mesh, mesh_paths, world_mesh
from exporters.formats import npz, points, vdb
from exporters.formats.axes import coordinates_from_world
from exporters.formats.colmap import colmap_files, is_model_file
from exporters.formats.exr import is_picture
from exporters.formats.parity import check_points_bytes, check_steps, check_volume_bytes
from exporters.formats.transforms import moved_cameras, transforms_bytes
from exporters.head.asset_head import head_bytes
from exporters.options import FOLDERS, MESHES, POINTS, ExportOptions, check_options
from exporters.pages import export_page, page_files
from exporters.pictures import export_pictures
from exporters.shapes.crop import parse_crop
from exporters.shapes.mesh import TriangleMesh
from exporters.shapes.volume import asset_volume
from exporters.surface.asset_surface import AssetSurface
from exporters.surface.inner_region import inner_region
from player.asset.asset import Asset
from player.asset.target import asset_files
from player.cameras.camera import Camera
from player.cameras.transforms import frame_names
from player.cameras.views import asset_cameras, read_views
from player.errors import OutputError
from player.files.content import content_of
from player.files.files import check_target, new_folder, write_bytes
from player.progress import Report, silent

Facts = dict[str, Any]
"""Description of an export: JSON values by name."""


def export_asset(
    asset_path: Path,
    target: Path,
    options: ExportOptions | None = None,
    report: Report | None = None,
) -> Facts:
    """Export the asset in `asset_path` to one file or folder, and return a description.

    Args:
        asset_path: the folder of an asset; every checksum is compared.
        target: what to write.
        options: the settings; by default the mesh is written in the world's coordinates and in the format of
            the suffix.
        report: called with (stage, done, of) during the steps that take long.

    Returns:
        JSON values: `file`, `format`, `bytes`, and those that apply to the format. Meshes: `vertices`,
        `faces`, `bounds` [2][3] in WORLD units and axes whatever the frame, `frame`, `removed` (share of the
        faces that a crop removed), `faces_asked`, `texture` (its size), `lods` (`file`, `vertices`, `faces`,
        `bytes` of each level). A surface that was made again: `method`, `unseen_faces_removed`,
        `haze_faces_removed`, `floaters_removed`, `floater_faces_removed`. Volumes: `voxels`, `densities`
        (their range) and `level` (half opaque over a voxel), 1/unit of the frame. Others: `points`;
        `cameras`; `pictures`, `channels` and, if something of the cameras is ignored, `notes` (lines);
        `inputs`, `outputs`; for a page `viewer_bytes` (all but the scene's data and the poster) and
        `gpu_bytes`.

    Raises:
        ConfigError: an unknown suffix, a setting that does nothing or is out of range, an empty crop, an
            asset or a picture that takes more memory than it may, a page that takes more graphics memory or
            has more channels than browsers can draw, two files with the same name, or a mesh or points so far
            from the origin that float32 would deform them.
        DataError: there is no surface.
        OutputError: the target exists and `force` is not set, or cannot be written.
        FormatError: the asset, its mesh or a file of cameras is damaged.
        ParityError: what was written does not hold what was to be written.
        MissingExtraError: the format needs a package that is not installed.
    """
    options = options or ExportOptions()
    report = report or silent
    name = check_options(target, options)
    is_mesh = name in MESHES and options.points is None
    if is_mesh:
        for path in itertools.chain.from_iterable(mesh_paths(target, options, name)):
            _check_target(asset_path, path, name, options.force)
    check_packages(options, name)
    force = _check_target(asset_path, target, name, options.force)
    asset = Asset.open(asset_path, verify=True, max_memory=options.max_memory)
    # The mesh that the asset stores needs no densities, and bringing them to one level may take much memory.
    is_stored = options.method == "baked" and options.texture is None
    if name not in ("exr", "json", "onnx", "html", "web") and not is_stored:
        asset = inner_region(asset, options.max_memory)
    matrix = coordinates_from_world(options.coordinates, asset.world_from_model, name)
    if is_mesh:
        facts = export_mesh(asset, target, options, name, matrix, report)
    elif name == "exr":
        notes: list[str] = []
        cameras, names = _views(asset, options, notes.append)
        progress = partial(report, "picture")
        facts = export_pictures(asset, target, cameras, names, options, force, progress)
        facts |= {"notes": notes} if notes else {}
    elif name in ("html", "web"):
        facts = export_page(asset, target, name, options.max_gpu_mb, force)
    elif name == "colmap":
        facts = _export_colmap(asset, target, options, matrix, force, report)
    else:
        if name == "json":
            data, facts = _cameras(asset, target, options, matrix)
        elif name == "onnx":
            data, facts = _head(asset, target, options)
        elif name in ("vdb", "npz"):
            data, facts = _volume(asset, target, options, name, matrix)
        else:
            data, facts = _points(asset, target, options, matrix, report)
        write_bytes(target, data)
        facts["bytes"] = len(data)
    return {"file": str(target), "format": name, **facts}


def _volume(
    asset: Asset, target: Path, options: ExportOptions, name: str, matrix: np.ndarray
) -> tuple[bytes, Facts]:
    box = None if options.crop is None else parse_crop(options.crop)
    volume, removed = asset_volume(asset, matrix, box, options.colour)
    written = volume.for_blender() if (name, options.frame) == ("vdb", "blender") else volume
    if name == "vdb" and options.colour:  # whose grid of colours is a voxel wider
        written = written.with_margin()
    data = npz.npz_bytes(volume, options.coordinates) if name == "npz" else vdb.vdb_bytes(written)
    check_volume_bytes(f".{name}", data, written, str(target))
    places = np.c_[volume.points(), np.ones(len(volume.index))] @ np.linalg.inv(matrix).T
    facts = {
        "voxels": len(volume.index),
        "level": volume.level,
        "densities": [float(volume.density.min()), float(volume.density.max())],
        "bounds": [places[:, :3].min(axis=0).tolist(), places[:, :3].max(axis=0).tolist()],
        "frame": options.coordinates,
    }
    return data, facts | ({"removed": removed} if box is not None else {})


def _points(
    asset: Asset, target: Path, options: ExportOptions, matrix: np.ndarray, report: Report
) -> tuple[bytes, Facts]:
    surface = AssetSurface(asset, report)
    mesh, facts = world_mesh(surface, options)
    check_steps(mesh.transformed(matrix), str(target), NEARER)
    cloud, facts = _cloud(surface, mesh, facts, options)
    moved = cloud.transformed(matrix)
    data = points.points_bytes(moved)
    check_points_bytes(data, moved, str(target))
    return data, facts


def _cameras(asset: Asset, target: Path, options: ExportOptions, matrix: np.ndarray) -> tuple[bytes, Facts]:
    cameras = asset_cameras(asset)
    data = transforms_bytes(cameras, matrix, str(target))
    return data, {"cameras": len(cameras), "frame": options.coordinates}


def _head(asset: Asset, target: Path, options: ExportOptions) -> tuple[bytes, Facts]:
    inputs = ["codes", "weights", "dirs"] if options.decode else ["features", "dirs"]
    return head_bytes(asset, options.decode, str(target)), {"inputs": inputs, "outputs": ["rgb"]}


def _export_colmap(
    asset: Asset, target: Path, options: ExportOptions, matrix: np.ndarray, force: bool, report: Report
) -> Facts:
    surface = AssetSurface(asset, report)
    mesh, facts = world_mesh(surface, options)
    cloud, facts = _cloud(surface, mesh, facts, options)
    cameras = moved_cameras(asset_cameras(asset), matrix)
    files = colmap_files(cameras, cloud.transformed(matrix))
    with new_folder(target, force) as folder:
        for file_name, data in files.items():
            (folder / file_name).write_bytes(data)
    return {"cameras": len(cameras), **facts, "bytes": sum(map(len, files.values()))}


def _cloud(
    surface: AssetSurface, mesh: TriangleMesh, facts: Facts, options: ExportOptions
) -> tuple[TriangleMesh, Facts]:
    """Return points on the mesh that `world_mesh` returned, and the facts about it with those about them."""
    cloud = points.sample_points(
        surface.painted(mesh) if "method" in facts else mesh, options.points or POINTS
    )
    return cloud, {"points": len(cloud.vertices), "bounds": bounds_of(cloud), **facts}


def _views(
    asset: Asset, options: ExportOptions, say: Callable[[str], object]
) -> tuple[list[Camera], list[str]]:
    """Return the cameras to render and the names of their files, which `vfr-play` would give them, too."""
    width, height = asset.manifest.view_size
    given = options.cameras
    cameras = asset_cameras(asset) if given is None else read_views(given, (width, height), say)
    part = options.views or slice(None)
    cameras, names = cameras[part], frame_names(cameras)[part]
    return ([c.fitted(*options.size) for c in cameras] if options.size else cameras), names


def _check_target(asset_path: Path, target: Path, name: str, force: bool) -> bool:
    """Raise OutputError if the target cannot be written, before any work; return whether to replace it.

    A folder is replaced as a whole, so it must hold nothing but an earlier export of its kind. The content of
    its files is looked at, because other programs give theirs the same names.
    """
    is_folder = name in FOLDERS
    if target.is_dir() and is_folder:
        is_ours = page_files(target) if name == "web" else {"exr": is_picture, "colmap": is_model_file}[name]
        found = content_of(target)
        other = [file.name for file in found if not is_ours(file)]
        if other:
            raise OutputError(
                f"{target}: expected no folder, or one of {name} files that vfr-export wrote, got {other[0]} "
                f"in it: name another folder, or move {other[0]} out of it"
            )
        force = force or not found
    elif target.exists() and target.is_dir() != is_folder:
        wanted, there = ("folder", "file") if is_folder else ("file", "folder")
        raise OutputError(f"{target}: expected the name of a {wanted}, got a {there}")
    own = {asset_path.resolve() / file for file in ("", *(asset_files(asset_path) or ()))}
    if target.resolve() in own:
        raise OutputError(f"{target}: is part of the asset: name another {'folder' if is_folder else 'file'}")
    check_target(target, force)
    return force
