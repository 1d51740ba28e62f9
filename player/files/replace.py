"""How what is complete gets its name, in one step, and what becomes of what a killed process leaves behind.

Everything is first written beside its place, as `.NAME.xxxxxxxx.part`. Then

- a file is renamed: the system replaces an old one in one step;
- a folder is exchanged with an old one in one step where the system and the disk can (Linux, macOS).
  Elsewhere the old one is `.NAME.replaced` between two renames;
- files that belong together are collected in one folder. When it is complete it is renamed to
  `.NAME.together`, and the files are moved out of it to their places.

`clear_up` finishes what was interrupted: it moves out what is together, gives an old folder its name back
where there is no new one, and removes what else is left. It is called before anything is written into a
folder, and where an asset is looked for and nothing is found.

A temporary file may belong to a process that is still writing. Every process that has one holds a shared lock
on the folder (flock), which the system takes away when the process ends, however it ends. Only who can have
the folder alone removes what is left. Windows has no such lock, and some disks of other machines have none:
there `.part` files stay until somebody removes them.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from player.errors import OutputError

PART = ".part"
_PARTS = re.compile(r"\..+\.[a-z0-9_]{8}\.part", re.DOTALL)  # as tempfile makes them
_TOGETHER = re.compile(r"\.(.+)\.together", re.DOTALL)
_REPLACED = re.compile(r"\.(.+)\.replaced", re.DOTALL)
_NO_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)  # of a disk that cannot do this to a folder
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # Linux: fcntl.h, linux/fs.h
_RENAME_SWAP = 2  # macOS: sys/stdio.h


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Nobody clears up in `folder` while the block writes there.

    What an earlier process left there is cleared up when this process first comes to the folder.
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
    """Finish or remove what processes that were killed have left in `folder`, unless others write there."""
    handle = _opened(folder)
    try:
        alone = handle is not None and _lock(handle, alone=True)
        if alone is None:
            return
        paths = []
        with suppress(OSError):  # no such folder, or one that is not ours to read
            paths = sorted(folder.glob(".*"))
        for path in paths:
            with suppress(OSError):  # not ours to change: whoever writes there is told
                _clear_up(path, alone)
    finally:
        if handle is not None:
            os.close(handle)


_clear_up_once = cache(clear_up)


def _clear_up(path: Path, alone: bool) -> None:
    if _TOGETHER.fullmatch(path.name):
        move_out(path)
    elif replaced := _REPLACED.fullmatch(path.name):
        place = path.with_name(replaced[1])
        if not os.path.lexists(place):
            path.replace(place)
        elif alone:
            remove(path)
    elif alone and _PARTS.fullmatch(path.name):
        remove(path)


def put_folder(new: Path, path: Path) -> None:
    """Give the folder `new` the name `path`. What had that name is removed, or has the name `new` afterwards;
    the names are on the disk before anything is removed.

    Raises OSError: the old one is still there. OutputError: it is under another name, which is said.
    """
    if not os.path.lexists(path):
        new.replace(path)
        return
    if exchange(new, path):
        sync(path.parent)
        return
    aside = path.with_name(f".{path.name}.replaced")
    remove(aside)
    path.replace(aside)
    try:
        new.replace(path)
    except BaseException:
        if not path.exists():
            _restore(aside, path)
        raise
    sync(path.parent)
    remove(aside)


def _restore(aside: Path, path: Path) -> None:
    try:
        aside.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot put the old one back: {error.strerror or error}: it is in {aside}"
        ) from error


def exchange(one: Path, other: Path) -> bool:
    """Exchange what two names stand for in one step; False if that cannot be done here.

    >>> exchange(Path("surely/not"), Path("there"))
    False
    """
    names = os.fsencode(one), os.fsencode(other)
    try:
        if sys.platform == "linux":
            rename = ctypes.CDLL(None).renameat2
            return rename(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0
        if sys.platform == "darwin":
            return ctypes.CDLL(None).renamex_np(*names, _RENAME_SWAP) == 0
    except AttributeError:  # an old system
        pass
    return False


def put_together(new: Path, name: str) -> None:
    """Move the files in the folder `new` to the folder that it is in, all of them or none: once it has begun,
    the next process that writes there ends it.

    Args:
        new: a temporary folder, complete.
        name: of one of the files.

    Raises OSError: nothing has changed, or, where a file is in use, some are still to be moved.
    """
    together = new.with_name(f".{name}.together")
    for tries_left in reversed(range(10)):
        try:
            new.rename(together)
            break
        except OSError:
            if not together.is_dir() or not tries_left:
                raise
            move_out(together)  # of another process that writes the same: its files, then ours
    sync(together.parent)
    move_out(together)


def move_out(folder: Path) -> None:
    """Move the files in `.NAME.together` to the folder that it is in, and remove it. Others may do so at the
    same time.

    A folder that somebody has unpacked may look like one: only files that begin like NAME, up to its first
    dot, are moved.
    """
    together = _TOGETHER.fullmatch(folder.name)
    if together is None or folder.is_symlink() or not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        if path.name.split(".")[0] == together[1].split(".")[0] and path.is_file() and not path.is_symlink():
            with suppress(FileNotFoundError):
                path.replace(folder.parent / path.name)
    with suppress(OSError):
        folder.rmdir()


def remove(path: Path) -> None:
    """Remove a file or a folder with what is in it, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk; Windows has no such thing for folders."""
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
    """`sync` for a folder and everything in it."""
    for place, _, names in os.walk(folder):
        for name in names:
            sync(Path(place) / name)
        sync(Path(place))


def _opened(folder: Path) -> int | None:
    """A handle of a folder that is there, where folders have such."""
    with suppress(OSError):
        return os.open(folder, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)) if os.name == "posix" else None
    return None


def _lock(handle: int, alone: bool) -> bool | None:
    """True: the folder is locked. False: there are no locks here. None: it was wanted `alone`, and is not."""
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
