"""The folders in which compiled code is kept, so that it is compiled only once, and the check that it is
still valid.

numba keeps what it has compiled. Before it loads that again, it checks only the file of the function itself:
code that the function took from other files stays as it was. Here the name of the folder and the index
contain a digest of all sources that compiled code is made from, and of the versions of what compiles it. So
what was compiled from other sources is not found, wherever it is and whatever its file times are.

Kept code is loaded with pickle, which means that it is executed: whoever may write to the folder may run
programs as the user who plays. So these folders are created for their owner alone, and a folder that others
may write to is not used.

The places of these folders are those of numba: NUMBA_CACHE_DIR, beside the sources, and the user's caches.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import stat
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite
import numba
import numpy as np
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.misc.appdirs import AppDirs

# numba reads settings from a file in the current folder. One of them is the folder of compiled code, which is
# unpickled: whoever writes that file could run code. With an empty name, no such file is read.
config._config_fname = ""  # pyright: ignore[reportAttributeAccessIssue]
config.reload_config()

N_KEPT = 4
"""Folders for other sources that stay, those used last: versions that are used in turns keep their code."""


class Place(NamedTuple):
    """The folder in which code that is compiled from some sources is kept."""

    folder: Path | None
    """The folder; None if code cannot be kept."""
    digest: str
    """Digest of the sources and of what compiles them."""
    refused: Path | None
    """A folder that is not used because others may write to it."""


def keep(dispatcher: Any, *packages: Path) -> Any:
    """Make numba load a compiled function from the folder of `place` if it is kept there, and keep it there
    otherwise.

    Args:
        dispatcher: the result of `numba.njit`.
        packages: folders of all sources that the function is made from, the function's own first. A function
            of another file is not kept, because a change of that file would not be noticed.
    """
    function = getattr(dispatcher, "py_func", None)
    if function is None:  # with NUMBA_DISABLE_JIT, `dispatcher` is the function itself
        return dispatcher
    where = place(*packages)
    if where.folder is not None and Path(function.__code__.co_filename).is_relative_to(packages[0]):
        dispatcher._cache = _KeptCode(function, where)
    return dispatcher


def is_kept(name: str, *packages: Path) -> bool:
    """Return whether any run has compiled the function `name` from the sources in `packages`, and kept it."""
    folder = place(*packages).folder
    return folder is not None and any(folder.glob(f"*.{name}-*.nbi"))


def user_folder() -> Path:
    """Return the user's folder for files that are kept between runs: `$XDG_CACHE_HOME/vfr-bake` on every
    system; if that variable is not set, the system's own place for such folders."""
    root = os.environ.get("XDG_CACHE_HOME")
    return Path(root) / "vfr-bake" if root else Path(AppDirs("vfr-bake", appauthor=False).user_cache_dir)


@lru_cache(maxsize=8)
def place(*packages: Path) -> Place:
    """Find where code of the sources in `packages` is kept; the folder is made if it does not exist."""
    digest = sources_digest(*packages)
    if digest is None:
        return Place(None, "", None)
    told, beside = getattr(config, "CACHE_DIR", ""), packages[0] / "__pycache__"
    refused = None
    for root in (*([Path(told)] if told else []), beside, user_folder()):
        folder = root / f"compiled-{digest[:16]}"
        try:
            _make(root)
            new = _make(folder)
            # Whoever may write beside the sources may change the sources themselves.
            if _is_ours(folder) and (root == beside or _is_ours(root)):
                probe = folder / f"probe-{secrets.token_hex(4)}"  # `tempfile` tries for hours on Windows
                probe.touch()
                probe.unlink()
                os.utime(folder)  # marks it as used now
                if new:
                    _remove_old(root, folder)
                return Place(folder, digest, None)
        except OSError:  # nothing can be written there
            continue
        refused = root
        if told:
            break  # the user has chosen this place, and is told of the refusal
    return Place(None, digest, refused)


@lru_cache(maxsize=8)
def sources_digest(*packages: Path) -> str | None:
    """Return a digest of all sources below the folders `packages` and of the versions of what compiles them;
    None without sources."""
    versions = sys.version, numba.__version__, llvmlite.__version__, np.__version__
    total, n_files = hashlib.sha256("\n".join(versions).encode()), 0
    for package in packages:
        for path in sorted(package.rglob("*.py")):
            content = path.read_bytes()
            total.update(f"\n{path.relative_to(package).as_posix()} {len(content)}\n".encode())
            total.update(content)
            n_files += 1
    return total.hexdigest() if n_files else None


def _make(folder: Path) -> bool:
    """Make a folder for its owner alone, if it does not exist; returns whether it was made."""
    if folder.is_dir():
        return False
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    return True


def _is_ours(folder: Path) -> bool:
    """Return whether only this user and the system's administrator may write to a folder."""
    if os.name != "posix":
        return True  # a user's folders are that user's alone
    found = folder.stat()
    return found.st_uid in (os.geteuid(), 0) and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _remove_old(root: Path, used: Path) -> None:
    """Remove the folders for other sources, except those used last."""
    with suppress(OSError):  # another process may remove them, too
        others = [path for path in root.glob("compiled-*") if path != used and path.is_dir()]
        for path in sorted(others, key=lambda path: path.stat().st_mtime)[:-N_KEPT]:
            shutil.rmtree(path, ignore_errors=True)


class _Locator(_CacheLocator):
    def __init__(self, function: Callable[..., Any], where: Place) -> None:
        self._py_file = function.__code__.co_filename  # numba names it in a warning
        self._line, self._where = function.__code__.co_firstlineno, where

    def get_cache_path(self) -> str:
        return str(self._where.folder)

    def get_source_stamp(self) -> str:
        return self._where.digest

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Files(CompileResultCacheImpl):
    def __init__(self, function: Callable[..., Any], where: Place) -> None:
        self._lineno = function.__code__.co_firstlineno
        self._locator = _Locator(function, where)
        name = f"{function.__module__}.{function.__qualname__}"
        self._filename_base = self.get_filename_base(name, getattr(sys, "abiflags", ""))


class _KeptCode(FunctionCache):
    def __init__(self, function: Callable[..., Any], where: Place) -> None:
        self._impl_class = partial(_Files, where=where)
        super().__init__(function)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a truncated or broken file may raise anything; it is written again
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):  # a full disk: it is compiled again the next time
            super().save_overload(sig, data)
