"""Writing so that the final name holds either the old content or the complete new one."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from player.errors import OutputError


def check_target(path: Path, force: bool = False) -> None:
    """Refuse a target that exists, unless `force`, or that cannot be written because it or its folder is
    read-only; called before long work, so that nobody waits for a refusal.

    >>> check_target(Path("surely/not/there.png"))
    """
    try:
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
    """Write every file beside its place; when all are complete, rename them into place, in their order.

    Raises OutputError: full disk, read-only folder, ...
    """
    complete: dict[Path, Path] = {}
    path = Path()
    try:
        for path, data in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
            complete[path] = Path(temporary)
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            complete[path].chmod(0o666 & ~_umask())
        for path, temporary_path in complete.items():
            temporary_path.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot write: {error.strerror or error}") from error
    finally:
        for temporary_path in complete.values():
            temporary_path.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path, force: bool = False) -> Iterator[Path]:
    """A temporary folder beside `path` that becomes `path` when the block ends well, and vanishes when it
    does not.

    With `force` a folder that exists is replaced, in two renames: the old one is gone only when the new one
    is complete. Raises OutputError: `path` exists, full disk, read-only folder, ...
    """
    check_target(path, force)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        temporary.chmod(0o777 & ~_umask())
        yield temporary
        _replace_folder(temporary, path)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"{path}: cannot write: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def _replace_folder(new: Path, path: Path) -> None:
    if not path.exists():
        new.replace(path)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent))
    old = aside / path.name
    try:
        path.replace(old)
        new.replace(path)
    finally:
        if not path.exists():
            _restore(old, path)
        shutil.rmtree(aside, ignore_errors=True)


def _restore(old: Path, path: Path) -> None:
    try:
        old.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot put the old one back: {error.strerror or error}: it is in {old}"
        ) from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
