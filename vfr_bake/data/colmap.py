"""A folder of pictures with a COLMAP model: `sparse/0/cameras.bin`, `images.bin` and `points3D.bin`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from player.cameras.camera import Camera
from player.cameras.colmap import colmap_folder, read_cameras, read_images, read_points
from player.errors import DataError, FormatError
from vfr_bake.data.capture import Capture, counter, held_out
from vfr_bake.data.pictures import read_pictures


def load_colmap_folder(folder: Path, progress: Callable[[int, int], object] | None = None) -> Capture:
    """The pictures of `folder` that its COLMAP model has registered, in the order of their names.

    Pictures are looked for in `images/` and in the folder itself; every eighth is held out. Raises DataError
    (pictures, camera models) or FormatError (the model's files), in one line that names the file.
    """
    model = colmap_folder(folder)
    assert model is not None
    lenses = read_cameras(model / "cameras.bin")
    registered = sorted(read_images(model / "images.bin"), key=lambda image: image.name)
    if len(registered) < 2:
        raise DataError(f"{model}: registered pictures: expected at least 2, got {len(registered)}")
    points_file = model / "points3D.bin"
    points = read_points(points_file) if points_file.exists() else None
    paths, cameras, distortions = [], [], []
    for image in registered:
        if image.camera_id not in lenses:
            raise FormatError(f"{model}: {image.name}: camera {image.camera_id} is not in cameras.bin")
        lens = lenses[image.camera_id]
        paths.append(_picture_path(folder, image.name))
        cameras.append(
            Camera(image.name, image.c2w, lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
        )
        distortions.append(lens.distortion)
    views = read_pictures(paths, cameras, distortions, counter(len(paths), progress))
    train, test = held_out(views)
    return Capture(folder.resolve().name or "scene", train, test, points)


def _picture_path(folder: Path, name: str) -> Path:
    inside = Path(name)
    if inside.is_absolute() or ".." in inside.parts:
        raise FormatError(f"{folder}: {name}: expected a picture inside the folder")
    for candidate in (folder / "images" / inside, folder / inside):
        if candidate.is_file():
            return candidate
    raise DataError(f"{folder}: {name}: picture is missing: expected {folder / 'images' / name}")
