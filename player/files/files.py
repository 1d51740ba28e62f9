"""Read regular files only, up to a stated size; and write so that the final name always holds either the old
content or the complete new one."""

from __future__ import annotations

import os
import secrets
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from player.errors import FormatError, OutputError
from player.files.replace import (
    PART,
    clear_up,
    held,
    put_folder,
    put_together,
    remove,
    rename,
    sync,
    sync_all,
)

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}
_FLAGS = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
"""With these flags a pipe that nobody writes to is opened at once and then refused, not waited for."""


def open_file(path: Path, what: str, most: int, inside: Path | None = None) -> BinaryIO:
    """Open a regular file of at most `most` bytes for reading; every file of a user is opened here.

    Args:
        path: the file; it may be a link.
        what: what the file is expected to be, for error messages.
        most: the largest size allowed, in bytes.
        inside: a folder that the file must lie in, once links are followed; None allows any place.

    Raises:
        FormatError: there is no such file, it is a folder, a pipe, a device or a socket, it is too large, it
            lies outside the folder, or it cannot be read.

    >>> open_file(Path("surely/not/there.json"), "cameras", 1000)
    Traceback (most recent call last):
    player.errors.FormatError: surely/not/there.json: no such file: expected cameras
    """
    with _told(path, what):
        place = path if inside is None else _inside(path, inside)
        _check_regular(path, what, place.stat())  # before opening, which may have effects on a device
        handle = os.open(place, _FLAGS)
        try:
            size = _check_regular(path, what, os.fstat(handle))  # it may be another file by now
            if size > most:
                raise FormatError(f"{path}: size: expected at most {most} bytes for {what}, got {size}")
            return os.fdopen(handle, "rb")
        except BaseException:
            os.close(handle)
            raise


def read_bytes(path: Path, what: str, most: int, inside: Path | None = None) -> bytes:
    """Return the content of a file; arguments and errors are those of `open_file`."""
    with open_file(path, what, most, inside) as file, _told(path, what):
        return file.read(os.fstat(file.fileno()).st_size)


def file_size(path: Path, what: str, inside: Path | None = None) -> int:
    """Return the size of a regular file in bytes, without opening it. Arguments and errors as `open_file`."""
    with _told(path, what):
        place = path if inside is None else _inside(path, inside)
        return _check_regular(path, what, place.stat())


@contextmanager
def _told(path: Path, what: str) -> Iterator[None]:
    """Turn an error of the operating system in the block into a FormatError about `path`."""
    try:
        yield
    except FormatError:
        raise
    except (FileNotFoundError, NotADirectoryError):
        raise FormatError(f"{path}: no such file: expected {what}") from None
    except (OSError, ValueError, RuntimeError) as error:  # a null in the name, links that lead to themselves
        raise FormatError(f"{path}: cannot read: {getattr(error, 'strerror', None) or error}") from error


def _check_regular(path: Path, what: str, found: os.stat_result) -> int:
    """Return the size of a regular file with the status `found`. Raises FormatError for anything else."""
    if not stat.S_ISREG(found.st_mode):
        got = _KINDS.get(stat.S_IFMT(found.st_mode), "something else")
        raise FormatError(f"{path}: cannot read: expected a file, {what}, got {got}")
    return found.st_size


def _inside(path: Path, folder: Path) -> Path:
    """Return the place of `path` once links are followed. Raises FormatError if it is not in `folder`."""
    place = path.resolve(strict=True)
    if not place.is_relative_to(folder.resolve()):
        raise FormatError(f"{path}: expected a file inside {folder}, got a link to {place}")
    return place


def check_target(path: Path, force: bool = False, is_file: bool = False) -> None:
    """Raise OutputError if a target exists, unless `force`, if it or its folder is read-only, or if it is a
    folder that cannot be replaced, the current one or a root. This is called before long work, so that nobody
    waits for an error that could have come at once.

    `is_file`: whether a file is to be written, which never replaces a folder.

    First, what a killed process has left in the folder is finished or removed (`player.files.replace`).

    >>> check_target(Path("surely/not/there.png"))
    """
    try:
        clear_up(_named(path).parent)
        if is_file and path.is_dir():
            raise OutputError(f"{path}: expected a file to write, got a folder: name a file in it")
        if path.is_dir() and path.samefile(Path.cwd()):  # whoever is in it would be left in the old one
            raise OutputError(
                f"{path}: expected a new folder, got the current one, which cannot be replaced: name one "
                "in it"
            )
        if path.exists() and not force:
            raise OutputError(f"{path}: already exists: add --force to replace it")
        if path.exists() and not os.access(path, os.W_OK):
            raise OutputError(f"{path}: cannot write: it is read-only")
        above = next(parent for parent in path.absolute().parents if parent.exists())
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"{path}: cannot write: {error.strerror or error}") from error
    if not above.is_dir():
        raise OutputError(f"{path}: cannot write: {above} is a file, not a folder")
    if not _takes_files(above):
        raise OutputError(f"{path}: cannot write: the folder {above} is read-only")


def _named(path: Path) -> Path:
    """Return `path` as a path that ends in a name: whole if it is "." or "..". Raises OutputError for a root,
    which has none."""
    place = path.resolve() if path.name in ("", "..") else path
    if not place.name:
        raise OutputError(
            f"{path}: expected a file or a folder to write, got the root of a disk: name one in it"
        )
    return place


def _takes_files(folder: Path) -> bool:
    """Return whether files can be made in `folder`. Windows only tells if one is made."""
    if sys.platform != "win32":
        return os.access(folder, os.W_OK)
    probe = _temporary_name(folder / "probe")
    try:
        probe.touch()
    except OSError:
        return False
    remove(probe)
    return True


def _temporary_name(path: Path) -> Path:
    """Return a new name beside `path`, by which `player.files.replace` knows what is not complete yet.

    It is made here because the functions of `tempfile` try for hours on Windows where nothing may be written,
    and make folders that nobody else may read.
    """
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}{PART}")


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to a temporary file beside `path` and rename this to `path`.

    Raises OutputError: full disk, read-only folder, ...
    """
    write_together({path: data})


def write_together(files: dict[Path, bytes]) -> None:
    """Write files that belong together: first to a temporary folder, then move all to their places.

    They must be for the same folder, and have the same names up to the first dot: `a.obj`, `a.lod1.obj`.

    A process that is killed while it moves them leaves some of the old files and some of the new ones. The
    next process that writes in this folder, or checks whether it may (`check_target`), moves the rest.

    Raises OutputError: full disk, read-only folder, ...
    """
    first = next(iter(files))
    if len({(path.parent, path.name.split(".")[0]) for path in files}) > 1:
        raise ValueError(f"{[str(path) for path in files]}: expected names that begin alike, in one folder")
    with _writing(first):
        if len(files) == 1:
            _write_one(first, files[first])
            return
        for path in files:
            if path.is_dir():
                raise OutputError(f"{path}: cannot write: it is a folder")
        with _temporary_folder(first) as folder:
            for path, data in files.items():
                (folder / path.name).write_bytes(data)
            put_together(folder, first.name)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Create the folder of `path` and hold it (`held`); turn errors of the system into an OutputError."""
    if path.name in ("", ".."):
        raise OutputError(f"{path}: cannot write: it is a folder")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with held(path.parent):
            yield
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{path}: cannot write: {error.strerror or error}") from error


def _write_one(path: Path, data: bytes) -> None:
    temporary = _temporary_name(path)
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a path with the name of `path` in a temporary folder beside it, for a library that writes files
    itself. The file becomes `path` when the block ends without an error.

    Raises OutputError: full disk, read-only folder, ...
    """
    with _writing(path), _temporary_folder(path) as folder:
        yield folder / path.name
        sync(folder / path.name)
        rename(folder / path.name, path)


@contextmanager
def new_folder(path: Path, force: bool = False) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, which becomes `path` when the block ends without an error, and
    is removed otherwise.

    With `force` a folder that exists is replaced when the new one is complete, in one step where the system
    can do this (`player.files.replace`). Raises OutputError: `path` exists, full disk, read-only folder, ...
    """
    check_target(path, force)
    path = _named(path)
    with _writing(path), _temporary_folder(path) as temporary:
        yield temporary
        sync_all(temporary)
        put_folder(temporary, path)


@contextmanager
def _temporary_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside `path`; whatever has its name when the block ends is removed."""
    folder = _temporary_name(path)
    folder.mkdir()
    try:
        yield folder
    finally:
        remove(folder)
