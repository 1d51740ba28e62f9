"""Find the pictures in a folder, as cameras, phones and people put them there."""

from __future__ import annotations

import os
import re
from pathlib import Path

from player.errors import DataError
from vfr_bake.data.files.masks import FOLDER as MASKS
from vfr_bake.data.files.opening import SUFFIXES

MOST = 20_000
"""Number of pictures of one capture at most: more are a whole collection, and not a scene."""
NOT_PICTURES = (MASKS, "mask", "sparse", "colmap", "__MACOSX", "@eaDir")
"""Folders that are not searched: masks, also where other data sets have them, COLMAP's models, and the
previews of some systems."""
CAMERAS = ("cameras*.npz", "poses_bounds.npy", "pose/*.txt")
"""Patterns of files in which other data sets have cameras (DTU, LLFF, and NSVF and Tanks and Temples)."""
OWN = ("transforms.json", "transforms_train.json", "sparse", "manifest.json")
"""A subfolder that has one of these is a data set or an asset of its own, and is not searched."""


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
    for folder, folders, names in os.walk(place):
        # Files whose names begin with a dot are left behind by systems (`._a.jpg` is no picture).
        folders[:] = sorted(
            name
            for name in folders
            if name[0] != "." and name not in NOT_PICTURES and not _is_own(Path(folder, name))
        )
        paths = [Path(folder, name) for name in names if name[0] != "."]
        found += [path for path in paths if path.suffix.lower() in SUFFIXES and path.is_file()]
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


def _is_own(folder: Path) -> bool:
    return any((folder / name).exists() for name in OWN)


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


def other_kinds(folder: Path) -> str:
    """Return a clause on the files in a folder that are pictures of formats that are not read; empty if there
    are none."""
    kinds = {
        path.suffix.lower()
        for place in (folder, folder / "images")
        if place.is_dir()
        for path in place.iterdir()
        if path.suffix.lower() in (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".jxl", ".bmp", ".gif")
    }
    return f"; there are {', '.join(sorted(kinds))} files: save them as JPEG" if kinds else ""
