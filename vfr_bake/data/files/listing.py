"""The pictures in a folder, as cameras, phones and people put them there."""

from __future__ import annotations

import os
import re
from pathlib import Path

from player.errors import DataError
from vfr_bake.data.files.masks import FOLDER as MASKS
from vfr_bake.data.files.opening import SUFFIXES

MOST = 20_000
"""Pictures of one capture at most: more are a whole life, and not a scene."""
NOT_PICTURES = (MASKS, "sparse", "colmap", "__MACOSX", "@eaDir")
"""Folders in which pictures are something else: masks, and the previews of some systems."""
OWN = ("transforms.json", "transforms_train.json", "sparse", "manifest.json")
"""A folder within a folder that has one of these is a data set or an asset of its own."""


def find_pictures(folder: Path) -> tuple[Path, list[Path]]:
    """The place that pictures lie in, `images/` or else the folder itself, and the pictures in it and in the
    folders within it, in the order of their names: numbers by their value, so that 9 comes before 10.

    Raises DataError: far too many, or a name that is not Unicode.

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
        # Names that begin with a dot are what systems leave behind (`._a.jpg` is no picture).
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
            path.name.encode()
        except UnicodeEncodeError:
            raise DataError(
                f"{str(path)!a}: expected a name in UTF-8: give the picture another one"
            ) from None
    return found


def _is_own(folder: Path) -> bool:
    return any((folder / name).exists() for name in OWN)


def _order(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isascii() and part.isdigit() else (0, part.casefold())
            for part in re.split("([0-9]+)", name)] + [(0, name)]  # fmt: skip


def other_kinds(folder: Path) -> str:
    """A clause on the files in a folder which are pictures that are not read; empty if there are none."""
    kinds = {
        path.suffix.lower()
        for place in (folder, folder / "images")
        if place.is_dir()
        for path in place.iterdir()
        if path.suffix.lower() in (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".jxl", ".bmp", ".gif")
    }
    return f"; there are {', '.join(sorted(kinds))} files: save them as JPEG" if kinds else ""
