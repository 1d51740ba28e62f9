"""Find the pictures in a folder, as cameras, phones and people put them there."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePath

from player.errors import DataError
from player.terminal import printable
from vfr_bake.data.files.masks import FOLDER as MASKS
from vfr_bake.data.files.opening import SUFFIXES
from vfr_bake.data.files.source import is_made
from vfr_bake.data.files.video import SUFFIXES as VIDEOS

MOST = 20_000
"""Number of pictures of one capture at most: more are a whole collection, and not a scene."""
NOT_PICTURES = (MASKS, "mask", "sparse", "colmap", "__MACOSX", "@eaDir")
"""Folders that are not searched: masks, also where other data sets have them, COLMAP's models, and the
previews of some systems."""
PREVIEW = ".preview.png"
"""End of the names of the previews that a training writes, which may be beside the photographs."""
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw")
UNREAD = (*RAW, ".jxl", ".bmp", ".gif")
"""Suffixes of pictures of formats that are not read."""
CAMERAS = ("cameras*.npz", "poses_bounds.npy", "pose/*.txt")
"""Patterns of files in which other data sets have cameras (DTU, LLFF, and NSVF and Tanks and Temples)."""
OWN = ("transforms.json", "transforms_train.json", "sparse", "manifest.json")
"""A subfolder that has one of these is a data set or an asset of its own, and is not searched. Nor is one
that was made from a video or a ZIP."""


def find_pictures(folder: Path) -> tuple[Path, list[Path]]:
    """Find the pictures in `images/`, or else in the folder itself, and in the folders within. Returns the
    folder that was searched, and the pictures in the order of their names: numbers by their value, so that 9
    comes before 10.

    Raises DataError: far too many pictures, or a name that is not Unicode.

    >>> find_pictures(Path("surely/not/there"))[1]
    []
    """
    for place in (folder / "images", folder):
        found = _below(place) if place.is_dir() else []
        if found:
            return place, sorted(found, key=lambda path: _order(path.relative_to(place).as_posix()))
    return folder, []


def _below(place: Path) -> list[Path]:
    found: list[Path] = []
    for path in _files(place):
        if _is_picture(path) and path.is_file():
            found.append(path)
        if len(found) > MOST:
            raise DataError(
                f"{place}: expected at most {MOST} pictures of one scene, got more: name the folder of those "
                "that belong together"
            )
    for path in found:
        try:
            path.relative_to(place).as_posix().encode()
        except UnicodeEncodeError:
            raise DataError(
                f"{str(path)!a}: expected a name in UTF-8: give the picture or its folder another one"
            ) from None
    return found


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.endswith(PREVIEW)


def _files(place: Path) -> Iterator[Path]:
    """Yield the files in a folder and in those within that are searched, each once: folders may be linked."""
    searched = {os.path.realpath(place)}
    for folder, folders, names in os.walk(place, followlinks=True):
        inside, folders[:] = sorted(folders), []
        for name in inside:
            # Files whose names begin with a dot are left behind by systems (`._a.jpg` is no picture).
            if name[0] == "." or name in NOT_PICTURES or _is_own(Path(folder, name)):
                continue
            real = os.path.realpath(Path(folder, name))
            if real not in searched:
                searched.add(real)
                folders.append(name)
        yield from (Path(folder, name) for name in names if name[0] != ".")


def _is_own(folder: Path) -> bool:
    return any((folder / name).exists() for name in OWN) or is_made(folder)


def unread_cameras(folder: Path) -> str | None:
    """Return the name of a file with cameras of a form that is not read, relative to the folder; None if
    there is none.

    >>> unread_cameras(Path("surely/not/there")) is None
    True
    """
    found = (path for pattern in CAMERAS for path in sorted(folder.glob(pattern)))
    return next((path.relative_to(folder).as_posix() for path in found), None)


def _order(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isascii() and part.isdigit() else (0, part.casefold())
            for part in re.split("([0-9]+)", name)] + [(0, name)]  # fmt: skip


def passed_over(folder: Path) -> str | None:
    """Return a sentence on the pictures in a folder, and in those within, that `find_pictures` does not find
    although it finds others; None if there are none. A raw file beside a photograph of its name is the same
    picture.

    >>> passed_over(Path("surely/not/there")) is None
    True
    """
    place, found = find_pictures(folder)
    names = {path.with_suffix("") for path in found}
    files = [path for path in _files(folder) if path.with_suffix("") not in names]
    told = []
    if outside := sorted(path.relative_to(folder).as_posix() for path in files if _is_picture(path)):
        told.append(f"{len(outside)} outside of {place.name}/ ({printable(outside[0][:200])})")
    if unread := [path.suffix.lower() for path in files if path.suffix.lower() in UNREAD]:
        told.append(f"{len(unread)} {' and '.join(sorted({*unread}))} files, which have to be saved as JPEG")
    return f"pictures that are not used: {'; '.join(told)}" if told else None


def other_kinds(folder: Path) -> str:
    """Return a clause on the files in a folder, and in those within, that are pictures of formats that are
    not read or videos, and on folders that were made from a video or a ZIP; empty if there are none."""
    told = named_kinds((path.relative_to(folder) for path in _files(folder)), "name it")
    if made := sorted(path.name for path in folder.glob("*") if is_made(path)):
        told += (
            f"; {printable(made[0])} was made from a video or a ZIP: name it, or copy the pictures of "
            "several such folders into a new one, in a folder each"
        )
    return told


def named_kinds(paths: Iterable[PurePath], cure: str) -> str:
    """Return a clause on the `paths` of pictures of formats that are not read, and of videos, with the `cure`
    for these; empty if there are none.

    >>> named_kinds([PurePath("a.NEF"), PurePath("b.nef"), PurePath("walk.MOV")], "name it")
    '; there are .nef files: save them as JPEG; there is a video, walk.MOV: name it'
    """
    told = ""
    paths = list(paths)
    if kinds := {path.suffix.lower() for path in paths} & {*UNREAD}:
        told += f"; there are {', '.join(sorted(kinds))} files: save them as JPEG"
    if videos := sorted(path.as_posix() for path in paths if path.suffix.lower() in VIDEOS):
        told += f"; there is a video, {printable(videos[0][:200])}: {cure}"
    return told
