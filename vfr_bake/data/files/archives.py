"""Unpack a ZIP of pictures, as phones and drives share it, into a folder.

A ZIP may come from strangers. So everything that it says is checked before the first byte is unpacked: names
that leave the folder, links, passwords, and the number of bytes that it unpacks to.
"""

from __future__ import annotations

import shutil
import stat
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from functools import partial
from lzma import LZMAError
from pathlib import Path, PurePosixPath, PureWindowsPath

from player.errors import DataError, OutputError
from player.files.files import new_folder
from player.progress import Progress
from vfr_bake.data.files.listing import named_kinds
from vfr_bake.data.files.opening import SUFFIXES
from vfr_bake.data.files.source import check_source, note_source

SUFFIX = ".zip"
KEPT = (*SUFFIXES, ".bmp", ".json", ".bin")
"""Suffixes of the files that are unpacked: pictures and masks, and the cameras of a data set."""
KEPT_TEXTS = ("cameras.txt", "images.txt", "points3D.txt")
"""Names of further files that are unpacked: a COLMAP model as text. Other files are left packed."""
MOST_ENTRIES = 50_000
MOST_BYTES = 1 << 37
"""137 GB, more than ten thousand pictures of 12 MB."""
MOST_OF_ONE = 1 << 30
MOST_TIMES, SPARED = 50, 64 << 20
"""The unpacked files may take at most MOST_TIMES the bytes of the ZIP and SPARED bytes more: pictures are
compressed already, and hardly grow."""
PIECE = 1 << 20
"""Bytes that are unpacked at a time."""
FREE = 0.9
"""Largest share of the free disk that is used."""
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, UnicodeError)
"""Exceptions that a damaged ZIP raises; the last one if a name is marked as UTF-8, and is not."""


def is_archive(path: Path) -> bool:
    """Return whether `path` is a file with the suffix of a ZIP.

    >>> is_archive(Path("surely/not/there.zip"))
    False
    """
    return path.suffix.lower() == SUFFIX and path.is_file()


def unpacked_folder(archive: Path) -> Path:
    """Return the folder into which a ZIP is unpacked: `garden.zip` -> `garden_unpacked`.

    >>> unpacked_folder(Path("a/garden.zip")).name
    'garden_unpacked'
    """
    return archive.with_name(f"{archive.stem}_unpacked")


def unpack(archive: Path, progress: Progress) -> Path:
    """Unpack the pictures and cameras of a ZIP into `<stem>_unpacked/` beside it.

    Returns the folder to load: the new folder, or the one inside it if that is all it contains.

    `progress`: called with the number of files unpacked and to unpack. The folder appears when it is
    complete; one that was unpacked before is used as it is.

    Raises DataError: not a ZIP, damaged, with a password, no pictures in it, a name that leaves the folder or
    that not every system can write, a link, more bytes than it may unpack to, or a folder that another ZIP
    was unpacked to; OutputError: the disk is too full.
    """
    folder = unpacked_folder(archive)
    if folder.is_dir():
        check_source(folder, archive)
        return _inner(folder)
    try:
        with zipfile.ZipFile(archive) as file:
            entries = _checked(archive, file)
            with new_folder(folder) as new:
                for done, (entry, name) in enumerate(entries, start=1):
                    _unpack_one(file, entry, new / name)
                    progress(done, len(entries))
                note_source(new, archive)
    except _DAMAGED as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise DataError(
            f"{archive}: ZIP: cannot be read to its end: {reason}: share or copy it again"
        ) from error
    return _inner(folder)


def _checked(archive: Path, file: zipfile.ZipFile) -> list[tuple[zipfile.ZipInfo, PurePosixPath]]:
    """Return the entries to unpack, with their names within the folder. Raises DataError, OutputError."""
    if len(file.infolist()) > MOST_ENTRIES:
        raise DataError(f"{archive}: ZIP: expected at most {MOST_ENTRIES} files, got {len(file.infolist())}")
    entries = []
    for entry in file.infolist():
        name = _safe_name(archive, entry)
        kept = name.suffix.lower() in KEPT or name.name in KEPT_TEXTS
        hidden = any(part.startswith((".", "__")) for part in name.parts)
        if kept and not hidden and not entry.is_dir():
            if ":" in str(name) or any(ord(character) < 32 for character in str(name)):
                raise DataError(
                    f"{archive}: ZIP: expected names without colons and control characters, got "
                    f"{ascii(str(name))[:200]}: unpack it yourself, and name the folder"
                )
            entries.append((entry, name))
    if any(entry.flag_bits & 1 for entry, _ in entries):
        raise DataError(f"{archive}: ZIP: expected one without a password: unpack it, and name the folder")
    if not entries:
        names = [PurePosixPath(_decoded(entry)) for entry in file.infolist()]
        raise DataError(
            f"{archive}: ZIP: expected pictures ({', '.join(SUFFIXES)}) in it, got none"
            f"{named_kinds(names, 'unpack it, and name it')}"
        )
    (name, times), *_ = Counter(str(name).casefold() for _, name in entries).most_common(1)
    if times > 1:
        raise DataError(f"{archive}: ZIP: expected different names, got {name} {times} times")
    n_bytes = sum(entry.file_size for entry, _ in entries)
    most = min(MOST_BYTES, MOST_TIMES * archive.stat().st_size + SPARED)
    largest = max(entry.file_size for entry, _ in entries)
    if n_bytes > most or largest > MOST_OF_ONE:
        raise DataError(
            f"{archive}: ZIP: expected at most {most / 1e9:.1f} GB of pictures and "
            f"{MOST_OF_ONE / 1e9:.1f} GB of one, got {n_bytes / 1e9:.1f} GB and {largest / 1e9:.1f} GB: "
            "unpack it yourself if you trust it"
        )
    free = shutil.disk_usage(archive.absolute().parent).free
    if n_bytes > FREE * free:
        raise OutputError(
            f"{unpacked_folder(archive)}: cannot write: {n_bytes / 1e9:.1f} GB to unpack, and the disk has "
            f"{free / 1e9:.1f} GB free"
        )
    return entries


def _safe_name(archive: Path, entry: zipfile.ZipInfo) -> PurePosixPath:
    """Return the name of an entry, which is checked to stay in the folder. Raises DataError."""
    name = PurePosixPath(_decoded(entry).replace("\\", "/"))
    on_windows = PureWindowsPath(str(name))
    if ".." in name.parts or name.is_absolute() or on_windows.drive or on_windows.root:
        raise DataError(
            f"{archive}: ZIP: expected names that stay in its folder, got {ascii(str(name))[:200]}"
        )
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise DataError(f"{archive}: ZIP: expected files, got a link: {ascii(str(name))[:200]}")
    return name


def _decoded(entry: zipfile.ZipInfo) -> str:
    """Return the entry's name. Many programs write UTF-8 without saying so, and `zipfile` reads it as code
    page 437."""
    if entry.flag_bits & 0x800:
        return entry.filename
    try:
        return entry.filename.encode("cp437").decode("utf-8")
    except UnicodeError:
        return entry.filename


def _unpack_one(file: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path) -> None:
    """Unpack an entry to `target`; `zipfile` ends it at the size that its directory states."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with target.open("xb") as copy:
        copy.writelines(_content(file, entry))


def _content(file: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Iterator[bytes]:
    """Yield the content of an entry piece by piece. Raises BadZipFile for errors of the system, of bzip2 and
    of LZMA, too, which could not be told from those of writing."""
    try:
        with file.open(entry) as source:
            yield from iter(partial(source.read, PIECE), b"")
    except (OSError, ValueError, LZMAError) as error:
        raise zipfile.BadZipFile(getattr(error, "strerror", None) or str(error)) from error


def _inner(folder: Path) -> Path:
    """Return the folder itself, or, as long as a folder has nothing but one other folder in it, that one:
    phones pack a folder instead of its contents. A folder `images` is not entered. Files of other kinds, such
    as systems leave behind when a folder is looked at, do not count."""
    while True:
        shown = (path for path in folder.iterdir() if path.name[0] != ".")
        inside = [path for path in shown if path.is_dir() or path.suffix.lower() in KEPT]
        if len(inside) != 1 or not inside[0].is_dir() or inside[0].name == "images":
            return folder
        folder = inside[0]
