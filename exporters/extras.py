"""Open3D, or what to install where it is missing."""

from __future__ import annotations

from typing import Any

from player.errors import MissingExtraError


def require_open3d(what: str) -> Any:
    """The package `open3d`, whose stubs know less than its code.

    Args:
        what: what needs it, the first words of the message: "--faces".

    Raises MissingExtraError: it is not installed, or a library of the system that it loads is missing.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:  # OSError: installed, but a library of the system is missing
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise MissingExtraError(
            f"{what}: needs open3d: pip install 'vfr-bake[export]' (on a bare machine also libusb-1.0-0, "
            f"libgl1): {reason}"
        ) from error
    return open3d
