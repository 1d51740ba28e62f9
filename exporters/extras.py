"""Imports of optional packages, with errors that say what to install where one is missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from player.errors import MissingExtraError


@contextmanager
def needs(what: str, package: str, also: str = "") -> Iterator[None]:
    """Wrap the import of a package that belongs to the extra `export`; if the import fails, raise
    MissingExtraError, which says how to install the package.

    Args:
        what: the option or task that needs the package, with which the message begins: "--faces".
        package: its name on PyPI.
        also: system libraries that the package loads and a bare machine lacks; the message then names them
            and the cause of the failure.

    >>> with needs("--faces", "scipy"):
    ...     import no_such_package
    Traceback (most recent call last):
    player.errors.MissingExtraError: --faces: needs scipy: pip install 'vfr-bake[export]'
    """
    try:
        yield
    except (ImportError, OSError) as error:  # OSError: installed, but a library of the system is missing
        message = f"{what}: needs {package}: pip install 'vfr-bake[export]'"
        if also:
            reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
            message += f" (on a bare machine also {also}): {reason}"
        raise MissingExtraError(message) from error


def require_open3d(what: str) -> Any:
    """Import and return `open3d`, which `what` needs, or raise MissingExtraError. The return type is Any
    because the package's type stubs are incomplete."""
    with needs(what, "open3d", also="libusb-1.0-0, libgl1"):
        import open3d
    return open3d
