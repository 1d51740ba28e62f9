"""Folders of pictures with their cameras: a transforms.json in the forms of NeRF-synthetic (Blender),
instant-ngp and nerfstudio, or a COLMAP model, `sparse/0/cameras.bin`, `images.bin` and `points3D.bin`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from player.cameras.camera import Camera
from player.cameras.colmap import (
    RegisteredImage,
    colmap_folder,
    numbered_models,
    read_cameras,
    read_images,
    read_points,
)
from player.cameras.transforms import load_transforms, transforms_cameras, transforms_number
from player.errors import DataError, FormatError
from player.files.json_files import as_float, brief
from player.progress import Progress
from vfr_bake.data.files.estimate_record import read_record
from vfr_bake.data.files.listing import find_pictures, other_kinds
from vfr_bake.data.files.masks import is_file, mask_of, stray_masks
from vfr_bake.data.files.opening import SUFFIXES, open_photograph
from vfr_bake.data.files.orientation import is_taken_upright
from vfr_bake.data.files.pictures import DescribedView, picture_layout, read_picture
from vfr_bake.data.store.capture import Capture, PosedImages, held_out
from vfr_bake.data.store.reading import PictureReader

DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
SAME = 1e-4
"""Largest difference between numbers of cameras that count as the same, in the units of the file: they may
have been rounded to different digits."""

N_LOOKED_AT = 8
"""Number of pictures with masks, at least, of which it is seen whether they are transparent by themselves."""


def load_folder(
    folder: Path, progress: Progress | None = None, reader: PictureReader | None = None
) -> Capture:
    """Load the pictures and cameras in `folder`, in whichever form they are there. `reader`: reads the
    pictures; None reads all of them, at their own size, into memory. Raises the same errors as
    `load_scene`."""
    if not folder.exists():
        raise DataError(f"{folder}: no such folder: expected one with pictures and cameras, or the word demo")
    if not folder.is_dir():
        raise DataError(f"{folder}: expected a folder with a transforms.json or a COLMAP model, got a file")
    reader = reader or PictureReader()
    if has_transforms(folder):
        return load_transforms_folder(folder, progress, reader)
    if (model := colmap_folder(folder)) is not None:
        return load_colmap_folder(folder, model, progress, reader)
    if find_pictures(folder)[1]:
        found = "pictures alone: vfr-train estimates their cameras"
    else:
        found = "none of them" if any(folder.iterdir()) else "an empty folder"
    raise DataError(
        f"{folder}: expected transforms_train.json, transforms.json or sparse/0/images.bin in it, got "
        f"{found}{other_kinds(folder)}"
    )


def load_transforms_folder(folder: Path, progress: Progress | None, reader: PictureReader) -> Capture:
    """Load the pictures of `folder` with their cameras from `transforms_train.json` and
    `transforms_test.json`, or from one `transforms.json`, split as its lists say if it has any (`_listed`).

    Raises DataError (pictures) or FormatError (JSON, cameras), in one line that names the file.
    """
    train_file, test_file = folder / "transforms_train.json", folder / "transforms_test.json"
    if not train_file.exists():
        train_file = folder / "transforms.json"
    document = load_transforms(train_file)
    train = _described_views(document, train_file, reader.say)
    if train_file.name == "transforms_train.json" and test_file.exists():
        test = _described_views(load_transforms(test_file), test_file, reader.say)
        train, test = _apart(train, test, reader.say)
    else:
        train, test = _listed(document, train_file, train)
    n_train, described = len(train), [*train, *test]
    if strays := stray_masks(folder, {view.mask for view in described}):
        reader.say(strays)
    if n_train < 2:
        raise DataError(f"{train_file}: training views: expected at least 2, got {n_train}")
    views = reader.read(described, progress)
    if not test:
        return _capture(folder, described, *held_out(views))
    return _capture(folder, described, views.some(range(n_train)), views.some(range(n_train, len(described))))


def _listed(
    document: dict[str, Any], path: Path, views: list[DescribedView]
) -> tuple[list[DescribedView], list[DescribedView]]:
    """Split the views of a transforms file as nerfstudio does, by its lists of `file_path`. Returns the views
    to train on, and those to test with.

    Test views are those in `test_filenames`, or in `val_filenames` if no test view is listed. Training views
    are those in `train_filenames`, or all that are in neither of the other lists; a test view is never one of
    them. Views that are left over are not used. Raises FormatError.
    """
    names = {_plain_name(view.camera.name) for view in views}
    lists: dict[str, set[str]] = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        listed = document.get(key, [])
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise FormatError(f"{path}: {key}: expected a list of file paths, got {brief(listed)}")
        lists[key] = {_plain_name(name) for name in listed}
        if unknown := sorted(lists[key] - names):
            raise FormatError(
                f"{path}: {key}: expected the file_path of a frame, got {brief(unknown[0])}: add the "
                "frame, or remove the name from the list"
            )
    test = lists["test_filenames"] or lists["val_filenames"]
    train = lists["train_filenames"] or names - lists["val_filenames"]
    return (
        [view for view in views if _plain_name(view.camera.name) in train - test],
        [view for view in views if _plain_name(view.camera.name) in test],
    )


def _plain_name(file_path: str) -> str:
    return PurePosixPath(file_path.replace("\\", "/")).as_posix()


def _capture(
    folder: Path,
    described: Sequence[DescribedView],
    train: PosedImages,
    test: PosedImages,
    points: np.ndarray | None = None,
) -> Capture:
    masked = any(view.mask is not None for view in described)
    name = folder.resolve().name or "scene"
    return Capture(name, train, test, points, masked, masked and _mostly_transparent(described))


def _mostly_transparent(described: Sequence[DescribedView]) -> bool:
    """Return whether at least half of some pictures, spread evenly, are transparent somewhere, whatever is
    masked. Raises DataError."""
    some = described[:: max(1, len(described) // N_LOOKED_AT)]
    return 2 * sum(_is_transparent(view.path) for view in some) >= len(some)


def _is_transparent(picture: Path) -> bool:
    try:
        with open_photograph(picture) as file:
            if not file.has_transparency_data:
                return False
    except FormatError as error:
        raise DataError(str(error)) from error
    return bool((read_picture(picture)[..., 3] < 255).any())


def has_transforms(folder: Path) -> bool:
    """Return whether `folder` holds the cameras of its pictures as a transforms file."""
    return any((folder / name).exists() for name in ("transforms_train.json", "transforms.json"))


def _described_views(
    document: dict[str, Any], path: Path, say: Callable[[str], object]
) -> list[DescribedView]:
    """Return the views of a transforms file, each once. Errors in the file are found before the first picture
    is decoded. `say`: called with a sentence if frames are repeated."""
    frames: list[dict[str, Any]] = document["frames"]
    paths = [_picture_path(path, index, frame) for index, frame in enumerate(frames)]
    layouts = [picture_layout(picture) for picture in paths]
    upright = [
        is_taken_upright(layout, _given_size(document, path, index)) for index, layout in enumerate(layouts)
    ]
    sizes = [layout.upright_size if up else layout.size for layout, up in zip(layouts, upright, strict=True)]
    cameras = transforms_cameras(document, path, sizes)
    distortions = [_distortion(document, path, index) for index in range(len(frames))]
    masks = [_mask(path, index, frames[index], picture) for index, picture in enumerate(paths)]
    for index, (picture, camera, size) in enumerate(zip(paths, cameras, sizes, strict=True)):
        _check_shape(f"{path}: frame {index} ({frames[index]['file_path']})", picture, camera, size)
    views = [DescribedView(*view) for view in zip(paths, cameras, distortions, upright, masks, strict=True)]
    return _each_once(path, views, say)


def _each_once(path: Path, views: list[DescribedView], say: Callable[[str], object]) -> list[DescribedView]:
    """Return the views without those that are there already: a view that is there twice would be both learned
    from and held out. Raises DataError: a picture has two different cameras."""
    known: dict[str, DescribedView] = {}
    kept = []
    for index, view in enumerate(views):
        first = known.setdefault(_place(view), view)
        if first is view:
            kept.append(view)
        elif not _same_camera(first, view):
            raise DataError(
                f"{path}: frame {index} ({view.camera.name}): expected one camera for each picture, got "
                "another one in an earlier frame: remove the wrong frame"
            )
    if len(kept) < len(views):
        n_again = len(views) - len(kept)
        say(f"{path.name}: {n_again} of {len(views)} frames repeat earlier ones, and are left out")
    return kept


def _apart(
    train: list[DescribedView], test: list[DescribedView], say: Callable[[str], object]
) -> tuple[list[DescribedView], list[DescribedView]]:
    """Return the training views that are no test views, because the scores of pictures that were learned from
    would be too high; and the test views. If that leaves nothing to train on, because one file is a copy of
    the other, there are no test views: some training views are held out then, as without that file."""
    held = {_place(view) for view in test}
    kept = [view for view in train if _place(view) not in held]
    if len(kept) < 2 <= len(train):
        say("transforms_test.json repeats the frames of transforms_train.json, and is not used")
        return train, []
    if len(kept) < len(train):
        n_out = len(train) - len(kept)
        say(
            f"transforms_train.json: {n_out} of {len(train)} frames are in transforms_test.json, too, and "
            "are left out"
        )
    return kept, test


def _place(view: DescribedView) -> str:
    """Return the path of a picture in one form. Links are not followed: in a cache of downloads, different
    frames whose pictures are equal are links to one file."""
    return os.path.normpath(view.path.absolute())


def _same_camera(one: DescribedView, other: DescribedView) -> bool:
    def numbers(view: DescribedView) -> np.ndarray:
        camera = view.camera
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        return np.array([*camera.c2w.reshape(-1), *lens, *view.distortion.values()])

    return np.allclose(numbers(one), numbers(other), rtol=0, atol=SAME)


def _check_shape(where: str, picture: Path, camera: Camera, size: tuple[int, int]) -> None:
    """Raise DataError unless a picture of `size` (width, height) has the shape that its camera has. Sizes of
    pictures that were made smaller may have been rounded by a pixel or two."""
    scale = max(size) / max(camera.width, camera.height)
    off = max(abs(size[0] - scale * camera.width), abs(size[1] - scale * camera.height))
    if off > max(2.0, 0.01 * min(size)):
        raise DataError(
            f"{where}: size: expected a picture of the shape of its camera, {camera.width}x{camera.height}, "
            f"got {size[0]}x{size[1]} in {picture.name}: take the picture that belongs to the camera, "
            "neither cropped nor turned, or give the camera of this picture"
        )


def _given_size(document: dict[str, Any], path: Path, index: int) -> tuple[float, float] | None:
    """Return the width and height that the file states for a frame, or for all frames; None if it states
    none."""
    frame = document["frames"][index]
    where = f"{path}: frame {index} ({frame['file_path']})"
    width, height = (transforms_number(document, frame, key, where) for key in ("w", "h"))
    return (width, height) if width is not None and height is not None else None


def _mask(path: Path, index: int, frame: dict[str, Any], picture: Path) -> Path | None:
    """Return the mask of a frame: the one that the frame names (nerfstudio's `mask_path`), or the one in
    `masks/`; None if it has none."""
    root = path.parent
    named = frame.get("mask_path")
    if named is not None:
        for form in (named, named.replace("\\", "/")) if isinstance(named, str) else ():
            if is_file(root / form):
                return root / form
        where = f"{path}: frame {index} ({frame['file_path']})"
        raise DataError(f"{where}: mask_path: expected a picture, got {brief(named)}")
    inside = picture.relative_to(root).as_posix() if picture.is_relative_to(root) else picture.name
    return mask_of(root, inside)


def _distortion(document: dict[str, Any], path: Path, index: int) -> dict[str, float]:
    """Return the lens distortion of a frame, whose numbers are given by name or by nerfstudio's list
    `distortion_params`. A frame takes precedence over the top, and a name over a list. Raises FormatError."""
    frame = document["frames"][index]
    where = f"{path}: frame {index} ({frame['file_path']})"
    distortion: dict[str, float] = dict.fromkeys(DISTORTION_KEYS, 0.0)
    for level in (document, frame):
        listed = level.get("distortion_params") or []
        values = listed if isinstance(listed, list) else []
        numbers = [number for value in values if (number := as_float(value)) is not None]
        if listed and not len(numbers) == len(values) == len(DISTORTION_KEYS):
            expected = f"expected {len(DISTORTION_KEYS)} finite numbers, {' '.join(DISTORTION_KEYS)}"
            raise FormatError(f"{where}: distortion_params: {expected}, got {brief(listed)}")
        distortion |= dict(zip(DISTORTION_KEYS, numbers, strict=False))
        for key in DISTORTION_KEYS:
            if (number := transforms_number({}, level, key, where)) is not None:
                distortion[key] = number
    return distortion


def _picture_path(transforms: Path, index: int, frame: dict[str, Any]) -> Path:
    name: str = frame["file_path"]
    for form in (name, name.replace("\\", "/")):
        path = transforms.parent / form
        for candidate in (path, *(path.with_name(path.name + suffix) for suffix in SUFFIXES if path.name)):
            if is_file(candidate):
                return candidate
    expected = f"expected {transforms.parent / name}"
    if not name.lower().endswith(SUFFIXES):
        expected += f" with one of {', '.join(SUFFIXES)}"
    raise DataError(f"{transforms}: frame {index} ({name}): picture is missing: {expected}")


def load_colmap_folder(
    folder: Path, model: Path, progress: Progress | None, reader: PictureReader
) -> Capture:
    """Load the pictures of `folder` that are registered in its COLMAP `model`, in the order of their names.

    Pictures are looked for in `images/` and in the folder itself; every eighth is held out. The pixels are
    taken as stored, unless this project estimated the model from upright pictures, or the cameras belong to
    upright pictures (`is_taken_upright`). Pictures that were removed after this project estimated the model
    are left out, and the reader says so; it also says which were replaced, and how many pictures have no
    camera in a model of another program. Of several models the one with the most pictures is taken.

    Raises DataError (pictures, camera models) or FormatError (the model's files), in one line that names the
    file.
    """
    lenses = read_cameras(model / "cameras.bin")
    registered = sorted(read_images(model / "images.bin"), key=lambda image: image.name)
    if len(registered) < 2:
        raise DataError(f"{model}: registered pictures: expected at least 2, got {len(registered)}")
    points_file = model / "points3D.bin"
    points = read_points(points_file) if points_file.exists() else None
    record = read_record(model)
    if (n_models := len(numbered_models(model))) > 1:
        reader.say(f"of {n_models} COLMAP models {model} is used, which has the most pictures")
    if record.upright:
        registered = _still_there(folder, registered, reader.say)
    else:
        _tell_of_others(folder, registered, reader.say)
    described, replaced = [], []
    for image in registered:
        if image.camera_id not in lenses:
            raise FormatError(f"{model}: {image.name}: camera {image.camera_id} is not in cameras.bin")
        lens = lenses[image.camera_id]
        size = (lens.width, lens.height)
        camera = Camera(image.name, image.c2w, *size, lens.fx, lens.fy, lens.cx, lens.cy)
        picture = _colmap_picture(folder, image.name)
        if record.n_bytes.get(image.name, n_bytes := picture.stat().st_size) != n_bytes:
            replaced.append(image.name)
        layout = picture_layout(picture)
        turned = record.upright or is_taken_upright(layout, size)
        shape = layout.upright_size if turned else layout.size
        _check_shape(f"{model}: {image.name}", picture, camera, shape)
        mask = mask_of(folder, image.name)
        described.append(DescribedView(picture, camera, lens.distortion, turned, mask))
    if replaced:
        reader.say(
            f"{len(replaced)} of {len(registered)} pictures are not those whose cameras were estimated "
            f"({replaced[0]}): remove {folder / 'sparse'} to have the cameras estimated anew"
        )
    if strays := stray_masks(folder, {view.mask for view in described}):
        reader.say(strays)
    train, test = held_out(reader.read(described, progress))
    return _capture(folder, described, train, test, points)


def _tell_of_others(folder: Path, registered: list[RegisteredImage], say: Callable[[str], object]) -> None:
    """Say how many pictures have cameras if another program has estimated these, and not of all."""
    place, pictures = find_pictures(folder)
    names = {path.relative_to(place).as_posix() for path in pictures} | {image.name for image in registered}
    if len(names) > len(registered):
        say(f"{len(registered)} of {len(names)} pictures have cameras; the others are not used")


def _still_there(
    folder: Path, registered: list[RegisteredImage], say: Callable[[str], object]
) -> list[RegisteredImage]:
    """Return the images of an estimated model whose pictures have not been removed since. Raises DataError:
    fewer than two."""
    there = [image for image in registered if _found_picture(folder, image.name) is not None]
    gone = [image.name for image in registered if _found_picture(folder, image.name) is None]
    if not gone:
        return there
    anew = f"remove {folder / 'sparse'} to have the cameras estimated anew"
    if len(there) < 2:
        raise DataError(
            f"{folder}: pictures whose cameras were estimated: expected at least 2, got {len(there)} "
            f"({gone[0]} is missing): {anew}"
        )
    say(
        f"{len(gone)} of {len(registered)} pictures whose cameras were estimated are missing ({gone[0]}), "
        f"and the others are used: {anew}"
    )
    return there


def _colmap_picture(folder: Path, name: str) -> Path:
    found = _found_picture(folder, name)
    if found is None:
        raise DataError(f"{folder}: {name}: picture is missing: expected {folder / 'images' / name}")
    return found


def _found_picture(folder: Path, name: str) -> Path | None:
    inside = Path(name)
    if inside.is_absolute() or ".." in inside.parts:
        raise FormatError(f"{folder}: {name}: expected a picture inside the folder")
    candidates = (folder / "images" / inside, folder / inside)
    return next((candidate for candidate in candidates if is_file(candidate)), None)
