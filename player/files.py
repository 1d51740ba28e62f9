"""Writing so that the final name holds either the old content or the complete new one."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from player.errors import OutputError
from player.replace import PART, clear_up, held, put_folder, put_together, remove, sync, sync_all


def check_target(path: Path, force: bool = False) -> None:
    """Refuse a target that exists, unless `force`, or that cannot be written because it or its folder is
    read-only; called before long work, so that nobody waits for a refusal.

    What a process that was killed has left in its folder is finished or removed first (`player.replace`).

    >>> check_target(Path("surely/not/there.png"))
    """
    try:
        clear_up(path.parent)
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
    if not os.access(above, os.W_OK):
        raise OutputError(f"{path}: cannot write: the folder {above} is read-only")


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` beside `path` and rename it into place.

    Raises OutputError: full disk, read-only folder, ...
    """
    write_together({path: data})


def write_together(files: dict[Path, bytes]) -> None:
    """Write files that belong together, all in one folder, beside their places; when all are complete, move
    them there.

    A process that is killed while it moves them leaves some of the old and some of the new: the next one that
    writes in this folder, or looks whether it may (`check_target`), moves the rest.

    Raises OutputError: full disk, read-only folder, ...
    """
    first = next(iter(files))
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
            sync_all(folder)
            put_together(folder, first.name)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """The folder of `path` is there and held, and what the system refuses is an OutputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with held(path.parent):
            yield
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{path}: cannot write: {error.strerror or error}") from error


def _write_one(path: Path, data: bytes) -> None:
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=PART, dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """A file of the same name in a temporary folder beside `path`, for a library that writes files itself; it
    becomes `path` when the block ends well.

    Raises OutputError: full disk, read-only folder, ...
    """
    with _writing(path), _temporary_folder(path) as folder:
        yield folder / path.name
        sync(folder / path.name)
        (folder / path.name).replace(path)


@contextmanager
def new_folder(path: Path, force: bool = False) -> Iterator[Path]:
    """A temporary folder beside `path` that becomes `path` when the block ends well, and vanishes when it
    does not.

    With `force` a folder that exists is replaced when the new one is complete, in one step where the system
    can (`player.replace`). Raises OutputError: `path` exists, full disk, read-only folder, ...
    """
    check_target(path, force)
    with _writing(path), _temporary_folder(path) as temporary:
        yield temporary
        sync_all(temporary)
        put_folder(temporary, path)


@contextmanager
def _temporary_folder(path: Path) -> Iterator[Path]:
    """A folder beside `path`; what then has its name is removed in the end."""
    folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=PART, dir=path.parent))
    try:
        folder.chmod(0o777 & ~_umask())
        yield folder
    finally:
        remove(folder)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
