"""Cameras from any file that has some: transforms.json, nerfstudio's camera_path.json, COLMAP, an asset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from player.asset.asset import Asset
from player.cameras import colmap
from player.cameras.camera import Camera
from player.cameras.nerfstudio import is_camera_path, path_cameras, path_frame_rate
from player.cameras.transforms import is_distorted, parse_transforms, transforms_cameras
from player.errors import FormatError
from player.files.json_files import parse_json, read_json

EXPECTED = "a transforms.json, a camera_path.json or the folder of a COLMAP model"


def read_views(
    path: str | Path, size: tuple[int, int] | None = None, say: Callable[[str], object] = lambda text: None
) -> list[Camera]:
    """Read the cameras of a file as pinhole cameras, in the file's order; those of COLMAP in the order of
    their names.

    Args:
        path: a transforms.json, a nerfstudio camera_path.json, or a COLMAP model: its folder, the folder
            above, or one of its files.
        size: (width, height) in pixels of cameras for which the file has no size.
        say: called with a line if cameras have lens distortion, which pinhole cameras do not have.

    Raises:
        FormatError: file, frame, expected, got.
        DataError: a COLMAP camera that is no pinhole.

    >>> [camera.name for camera in read_views("out/cameras.json")][:2]
    ['./test/r_0', './test/r_1']
    """
    path = Path(path)
    model = _colmap_model(path)
    if model is not None:
        return colmap.read_views(model, say)
    data = read_json(path, EXPECTED)
    document = parse_json(data, str(path))
    if is_camera_path(document):
        return path_cameras(document, path)
    document = parse_transforms(data, str(path))
    frames = document["frames"]
    if n_distorted := sum(is_distorted(document, frame) for frame in frames):
        say(f"{path}: lens distortion of {n_distorted} of {len(frames)} cameras is ignored")
    return transforms_cameras(document, path, [size] * len(frames))


def asset_cameras(asset: Asset) -> list[Camera]:
    """Read the training cameras that an asset holds, in the WORLD frame. Raises FormatError if they are
    damaged, or not those that the manifest lists.

    >>> [camera.name for camera in asset_cameras(Asset.open("out/"))][:2]
    ['./test/r_0', './test/r_1']
    """
    width, height = asset.manifest.view_size
    where = str(asset.path("cameras.json"))
    document = parse_transforms(asset.read("cameras.json"), where)
    return transforms_cameras(document, where, [(width, height)] * len(document["frames"]))


def frame_rate(path: str | Path) -> float | None:
    """Return the frames per second of a camera_path.json; None for any other file. Raises FormatError."""
    path = Path(path)
    if _colmap_model(path) is not None:
        return None
    document = parse_json(read_json(path, EXPECTED), str(path))
    return path_frame_rate(document, path) if is_camera_path(document) else None


def _colmap_model(path: Path) -> Path | None:
    """Return the folder with `images.bin` or `images.txt` that `path` refers to; None for a file of another
    kind."""
    if path.name in ("images.bin", "images.txt", "cameras.bin", "cameras.txt"):
        return path.parent
    if not path.is_dir():
        return None
    for folder in (path, colmap.colmap_folder(path) or path, *(path / name for name in colmap.FOLDERS)):
        if (folder / "images.bin").exists() or (folder / "images.txt").exists():
            return folder
    raise FormatError(f"{path}: expected {EXPECTED}, got a folder without images.bin or images.txt")
