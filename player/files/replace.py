"""Give complete files and folders their final names in one step, and clear up after killed processes.

Everything is first written beside its place, as `.NAME.xxxxxxxx.part`. Then

- a file is renamed: the system replaces an old one in one step;
- a folder is exchanged with an old one in one step where the system and the disk can do this (Linux, macOS).
  Elsewhere the old folder is called `.NAME.replaced` between two renames;
- files that belong together are collected in one folder. When this is complete, it is renamed to
  `.NAME.together`, and the files are moved out of it to their places.

`clear_up` finishes what was interrupted: it moves files out of `.NAME.together`, gives an old folder its name
back where there is no new one, and removes whatever else is left. It is called before anything is written
into a folder, and where an asset is looked for and nothing is found.

A temporary file may belong to a process that is still writing. Every process that has one holds a shared lock
on the folder (flock), which the system releases when the process ends, however it ends. Only a process that
gets an exclusive lock removes what is left. Windows has no such lock, and some network disks have none: there
`.part` files stay until somebody removes them.

An archive that somebody has unpacked may hold a folder `.NAME.together`, too, and must not replace any file.
Therefore files are moved only if the folder has a mark, a file that holds its own inode number: an archive
cannot know this number, which the disk gives to the file when it is made.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from player.errors import OutputError

PART = ".part"
MARK = ".inode"
"""Name of the file in `.NAME.together` that tells it from an unpacked folder."""
PAUSES = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Seconds between the tries to rename a file that another program has open, on Windows."""
_PARTS = re.compile(r"\..+\.[a-z0-9_]{8}\.part", re.DOTALL)  # 8 characters, as `tempfile` makes them, too
_TOGETHER = re.compile(r"\.(.+)\.together", re.DOTALL)
_REPLACED = re.compile(r"\.(.+)\.replaced", re.DOTALL)
_NO_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)  # errors of a disk that cannot sync a folder
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # Linux: fcntl.h, linux/fs.h
_RENAME_SWAP = 2  # macOS: sys/stdio.h


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep other processes from clearing up in `folder` while the block writes there.

    When this process first uses the folder, it clears up what earlier processes have left there.
    """
    _clear_up_once(folder.resolve())
    handle = _opened(folder)
    try:
        if handle is not None:
            _lock(handle, alone=False)
        yield
    finally:
        if handle is not None:
            os.close(handle)


def clear_up(folder: Path) -> None:
    """Finish or remove what killed processes have left in `folder`, unless other processes write there."""
    handle = _opened(folder)
    try:
        alone = handle is not None and _lock(handle, alone=True)
        if alone is None:
            return
        paths = []
        with suppress(OSError):  # no such folder, or no right to read it
            paths = sorted(folder.glob(".*"))
        for path in paths:
            with suppress(OSError):  # no right to change it: writing there will raise the error
                _clear_up(path, alone)
    finally:
        if handle is not None:
            os.close(handle)


_clear_up_once = cache(clear_up)


def _clear_up(path: Path, alone: bool) -> None:
    if _TOGETHER.fullmatch(path.name):
        _finish(path)
    elif (replaced := _REPLACED.fullmatch(path.name)) and path.is_dir():
        place = path.with_name(replaced[1])
        if not os.path.lexists(place):
            path.replace(place)
        elif alone:
            remove(path)
    elif alone and _PARTS.fullmatch(path.name):
        remove(path)


def put_folder(new: Path, path: Path) -> None:
    """Give the folder `new` the name `path`. A folder that had this name is removed, or is called `new`
    afterwards. The new names are synced to the disk before anything is removed.

    Raises OSError: the old folder still has its name. OutputError: it has the name that the message says.
    """
    if not os.path.lexists(path):
        rename(new, path)
        return
    if exchange(new, path):
        sync(path.parent)
        return
    aside = path.with_name(f".{path.name}.replaced")
    remove(aside)
    rename(path, aside)
    try:
        rename(new, path)
    except BaseException:
        if not path.exists():
            _restore(aside, path)
        raise
    sync(path.parent)
    remove(aside)


def rename(path: Path, to: Path) -> None:
    """Rename `path`; a file `to` is replaced. On Windows, this is tried again for some seconds while another
    program, such as a scanner for viruses, has a file open."""
    for pause in PAUSES if sys.platform == "win32" else ():
        try:
            path.replace(to)
        except PermissionError:
            time.sleep(pause)
        else:
            return
    path.replace(to)


def _restore(aside: Path, path: Path) -> None:
    try:
        aside.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot put the old one back: {error.strerror or error}: it is in {aside}"
        ) from error


def exchange(one: Path, other: Path) -> bool:
    """Exchange the files or folders of two names in one step. Return False if that cannot be done here.

    >>> exchange(Path("surely/not"), Path("there"))
    False
    """
    names = os.fsencode(one), os.fsencode(other)
    try:
        if sys.platform == "linux":
            swap = ctypes.CDLL(None).renameat2
            return swap(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0
        if sys.platform == "darwin":
            return ctypes.CDLL(None).renamex_np(*names, _RENAME_SWAP) == 0
    except AttributeError:  # an old system
        pass
    return False


def put_together(new: Path, name: str) -> None:
    """Move the files in the folder `new` to the folder that contains it, all of them or none: if a process is
    killed meanwhile, the next one that writes there finishes the moving.

    Args:
        new: a temporary folder, with all files; they are synced here.
        name: the name of one of the files.

    Raises OSError: nothing has changed, or, where a file is in use, some files are still to be moved.
    """
    together = new.with_name(f".{name}.together")
    mark(new)
    sync_all(new)
    for tries_left in reversed(range(10)):
        try:
            new.rename(together)
            break
        except OSError:
            if not together.is_dir():
                raise
            if not tries_left:
                raise OutputError(f"{together}: cannot write: remove this folder, or rename it") from None
            _finish(together)  # of another process that writes the same files: they come first
    sync(together.parent)
    move_out(together)


def mark(folder: Path) -> None:
    """Write a file into `folder` that says that this program has made the folder (`is_marked`)."""
    path = folder / MARK
    path.touch()
    path.write_text(str(path.stat().st_ino))


def is_marked(folder: Path) -> bool:
    """Return whether this program has made `folder`: not if it was copied or unpacked."""
    path = folder / MARK
    try:
        found = path.lstat()
        number = str(found.st_ino).encode()
        return stat.S_ISREG(found.st_mode) and found.st_size == len(number) and path.read_bytes() == number
    except OSError:
        return False


def _finish(folder: Path) -> None:
    """Move the files out of a folder `.NAME.together` that this program has made; remove an empty one."""
    if is_marked(folder):
        move_out(folder)
    else:
        with suppress(OSError):
            folder.rmdir()


def move_out(folder: Path) -> None:
    """Move the files in the folder `.NAME.together` whose names are the same as NAME up to the first dot to
    the folder that contains it, and remove it. Other processes may do the same at the same time."""
    together = _TOGETHER.fullmatch(folder.name)
    if together is None or folder.is_symlink() or not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        is_ours = path.name != MARK and path.name.split(".")[0] == together[1].split(".")[0]
        if is_ours and path.is_file() and not path.is_symlink():
            with suppress(FileNotFoundError):
                rename(path, folder.parent / path.name)
    with suppress(OSError):
        (folder / MARK).unlink()  # last: without it, nobody moves the rest
    with suppress(OSError):
        folder.rmdir()


def remove(path: Path) -> None:
    """Remove a file, or a folder with its content, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk. For folders on Windows, do nothing."""
    is_folder = path.is_dir()
    handle = _opened(path) if is_folder else os.open(path, os.O_RDWR)
    if handle is None:
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if not is_folder or error.errno not in _NO_SYNC:
            raise
    finally:
        os.close(handle)


def sync_all(folder: Path) -> None:
    """Call `sync` for a folder and everything in it."""
    for place, _, names in os.walk(folder):
        for name in names:
            sync(Path(place) / name)
        sync(Path(place))


def _opened(folder: Path) -> int | None:
    """Return a file descriptor of a folder; None if it cannot be opened, or on Windows."""
    with suppress(OSError):
        return os.open(folder, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)) if os.name == "posix" else None
    return None


def _lock(handle: int, alone: bool) -> bool | None:
    """Lock a folder, exclusively if `alone`. Return True if it is locked now, False if there are no locks
    here, and None if an exclusive lock was asked for and another process holds a lock."""
    if sys.platform == "win32":
        return False
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB if alone else fcntl.LOCK_SH)
    except BlockingIOError:
        return None
    except OSError:
        return False
    return True
