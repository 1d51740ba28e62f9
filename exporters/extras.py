"""Optional packages: what to install where one is missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from player.errors import MissingExtraError


@contextmanager
def needs(what: str, package: str, also: str = "") -> Iterator[None]:
    """Around the import of a package that comes with the extra `export`: raises MissingExtraError, which says
    how to get it.

    Args:
        what: what needs the package, the first words of the message: "--faces".
        package: its name on PyPI.
        also: libraries that it loads and that a bare machine lacks; the message then says why, too.

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
    """The package `open3d` for `what`, untyped: its stubs know less than its code. Or MissingExtraError."""
    with needs(what, "open3d", also="libusb-1.0-0, libgl1"):
        import open3d
    return open3d
