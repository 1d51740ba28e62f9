"""Load a data set from the disk, or the built-in scene, as posed views in the model frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from player.cameras.colmap import colmap_folder
from player.errors import DataError, FormatError
from player.files.json_files import as_float, brief
from player.progress import Progress
from vfr_bake.config import SceneKind, TrainConfig
from vfr_bake.data.demo import demo_capture
from vfr_bake.data.files.archives import is_archive, unpack
from vfr_bake.data.files.estimate_record import read_record
from vfr_bake.data.files.listing import find_pictures
from vfr_bake.data.files.source import check_source
from vfr_bake.data.files.video import frames_folder
from vfr_bake.data.folders import has_transforms, load_folder
from vfr_bake.data.poses import is_video
from vfr_bake.data.scene import Scene, build_scene
from vfr_bake.data.store.reading import DescribingReader, PictureReader
from vfr_bake.data.store.working import MAX_SIDE, WorkingSize
from vfr_bake.data.world import named, scaled


def load_scene(
    data: str | Path,
    progress: Progress | None = None,
    downscale: int | None = None,
    kind: SceneKind = "auto",
    scale: tuple[str, str, float] | None = None,
    reader: PictureReader | None = None,
) -> Scene:
    """Load the posed pictures that `data` names.

    `data`: a folder with `transforms_train.json` (NeRF-synthetic), `transforms.json` (instant-ngp,
    nerfstudio) or a COLMAP model (`sparse/0`), a ZIP of one, a video whose cameras have been estimated, or
    the word `demo` for the built-in scene (a folder of that name is `./demo`). `progress`: called with the
    number of pictures done and to do. `downscale`: pictures are reduced by this factor along each side.
    `kind`: object or unbounded; "auto" finds it from the pictures. `scale`: two pictures and the distance
    between their cameras; the world is scaled so that they are this far apart. `reader`: reads the pictures,
    and decides their size in place of `downscale`; None holds all of them in memory.

    Raises DataError or FormatError in one line that names the file and what was expected, and OutputError if
    the disk has no room for the pictures that the reader stores there.
    """
    reader = reader or PictureReader(WorkingSize(downscale=downscale))
    why: dict[str, str] = {}
    if str(data) == "demo":
        capture = demo_capture(progress=progress)
        train, test = reader.size.of(capture.train), reader.size.of(capture.test)
        capture = replace(capture, train=train, test=test)
    else:
        folder = unpacked(data)
        if is_video(folder):
            check_source(frames_folder(folder), folder)
            folder = frames_folder(folder)
        if (model := colmap_folder(folder)) is not None:
            why = read_record(model).why_without_camera()
        if scale is not None:  # what is mistyped is found out before the pictures are read
            scaled(load_folder(folder, None, DescribingReader()), *scale, why)
        capture = load_folder(folder, progress, reader)
    if scale is not None:
        capture = scaled(capture, *scale, why)
    return build_scene(capture, kind, reader.say)


def working_size(config: TrainConfig) -> WorkingSize:
    """Return the size at which pictures are trained on if the disk has room for them."""
    default = config.max_side is None and config.downscale is None
    return WorkingSize(MAX_SIDE if default else config.max_side, config.downscale)


def training_reader(
    config: TrainConfig, model: Path, kept: bool, say: Callable[[str], object] | None
) -> PictureReader:
    """Return the reader of the pictures for the training of `model`; with `kept` it leaves them on the disk
    for the next run."""
    default = config.max_side is None and config.downscale is None
    return PictureReader(working_size(config), model, on_disk=True, kept=kept, may_shrink=default, say=say)


def check_settings(settings: object, where: str) -> None:
    """Raise FormatError unless `reader_as` and `load_scene_as` understand the settings of a training that the
    file `where` records."""
    if not isinstance(settings, dict):
        raise FormatError(f"{where}: expected the settings of a training, got {brief(settings)}")
    for key in ("max_side", "downscale"):
        value = settings.get(key)
        if value is not None and (type(value) is not int or not 1 <= value <= 65536):
            raise FormatError(f"{where}: {key}: expected 1 to 65536, got {brief(value)}")
    scale = settings.get("scale")
    if scale is not None and not _is_scale(scale):
        raise FormatError(f"{where}: scale: expected two pictures and a distance, got {brief(scale)}")


def _is_scale(scale: object) -> bool:
    if not isinstance(scale, list | tuple) or len(scale) != 3:
        return False
    return all(isinstance(name, str) for name in scale[:2]) and 0 < (as_float(scale[2]) or 0) < 1e9


def reader_as(settings: dict[str, Any]) -> PictureReader:
    """Return a reader that gives pictures the size that they had in a training with these `settings`, as they
    are recorded in a model or an asset."""
    size = WorkingSize(settings.get("max_side"), settings.get("downscale"))
    return PictureReader(size, on_disk=True)


def load_scene_as(
    settings: dict[str, Any], unbounded: bool, data: str | Path, progress: Progress | None = None
) -> Scene:
    """Load the pictures that `data` names in the way in which a training with these `settings` loaded them:
    reduced to the same size, in the same unit, and with transparent pixels masked if the scene was trained as
    an `unbounded` one, and not if it was trained as an object. Models and assets record these settings. The
    other arguments and the errors are those of `load_scene`."""
    kind: SceneKind = "unbounded" if unbounded else "object"
    reader = reader_as(settings)
    return load_scene(data, progress, kind=kind, scale=settings.get("scale"), reader=reader)


def unpacked(data: str | Path, progress: Progress | None = None) -> Path:
    """Return the path that `data` names; for a ZIP, unpack it once and return its folder
    (`files.archives.unpack`).

    >>> unpacked("garden").name
    'garden'
    """
    path = Path(data)
    return unpack(path, progress or (lambda done, of: None)) if is_archive(path) else path


def check_scale(folder: Path, scale: tuple[str, str, float]) -> None:
    """Raise DataError unless the pictures that `scale` names are in a folder of pictures: what is mistyped is
    found out before their cameras are estimated."""
    place, pictures = find_pictures(folder)
    names = [path.relative_to(place).as_posix() for path in pictures]
    for name in scale[:2]:
        if not named(names, name):
            raise DataError(
                f"{folder}: scale: {name}: expected one picture of that name, got none: the first is called "
                f"{names[0]}"
            )


def needs_cameras(data: str | Path) -> bool:
    """Return whether `data` is a video or a folder of pictures without cameras, so that
    `poses.estimate_cameras` has to find them."""
    folder = Path(data)
    if is_video(folder):
        return True
    known = not folder.is_dir() or has_transforms(folder) or colmap_folder(folder) is not None
    return not known and bool(find_pictures(folder)[1])
