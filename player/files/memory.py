"""The memory that a command may take: what the user allows, or a share of what the machine has."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from numbers import Real
from pathlib import Path

from player.errors import ConfigError
from player.files.json_files import brief

SHARE = 0.5
"""The share of the machine's memory, or of a lower limit of the process, that is used where the user gives no
number. The rest is for the program itself, for pictures and for other programs."""
UNKNOWN = 4 << 30
"""Bytes of memory that the machine is assumed to have where the system does not tell."""


def available_bytes() -> int:
    """Return the bytes of memory that this process can have: its own limit, or all of the machine's."""
    return min([*_limits(), _machine_bytes()])


def allowed_bytes(max_memory: float | None = None) -> int:
    """Return the bytes of memory that a command may take.

    Args:
        max_memory: gigabytes that the user allows; None is a share (`SHARE`) of what this process can have.

    Raises ConfigError: `max_memory` is no number between 0 and 1e9.

    >>> allowed_bytes(1.5)
    1500000000
    """
    if max_memory is None:
        return int(SHARE * available_bytes())
    if not (isinstance(max_memory, Real) and 0 < max_memory < 1e9):
        raise ConfigError(f"max_memory: expected gigabytes, more than 0, got {brief(max_memory)}")
    return int(max_memory * 1e9)


def check_memory(needed: int, allowed: int, where: str) -> None:
    """Raise ConfigError if `where`, which is named in the message, needs more bytes than are allowed."""
    if needed > allowed:
        raise ConfigError(
            f"{where}: memory: expected at most {allowed / 1e9:.3g} GB, got {needed / 1e9:.3g} GB or more "
            "that it takes: allow more by --max-memory"
        )


def give_back() -> None:
    """Hand freed memory of this process back to the machine.

    glibc keeps freed memory for the thread that allocated it: for example that of all pictures that threads
    have read and that were copied since. With other C libraries nothing is done.
    """
    if sys.platform == "linux":
        import ctypes

        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)


def _machine_bytes() -> int:
    if sys.platform == "win32":
        return _windows_bytes()
    with suppress(OSError, ValueError, AttributeError):
        n_bytes = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        if n_bytes > 0:
            return n_bytes
    return UNKNOWN


def _windows_bytes() -> int:
    import ctypes

    class Status(ctypes.Structure):
        _fields_ = (
            ("length", ctypes.c_uint32),
            ("load", ctypes.c_uint32),
            *(
                (name, ctypes.c_uint64)
                for name in ("total", "free", "total_page", "free_page", "total_virtual")
            ),
            *((name, ctypes.c_uint64) for name in ("free_virtual", "free_extended")),
        )

    status = Status(length=ctypes.sizeof(Status))
    found = ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))  # type: ignore[attr-defined]
    return int(status.total) if found else UNKNOWN


def _limits() -> list[int]:
    """Return the limits of this process, in bytes: that of its address space, those of its control groups."""
    limits = []
    with suppress(ImportError, OSError, ValueError):
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_AS)
        if soft != resource.RLIM_INFINITY:
            limits.append(soft)
    return limits + _group_limits(Path("/proc/self/cgroup"), Path("/sys/fs/cgroup"))


def _group_limits(groups: Path, root: Path) -> list[int]:
    """Return the limits, in bytes, of this process's control group in Linux and of the groups above it.

    The file `groups` has a line for each hierarchy, "0::/path" or "5:memory:/path". A group's file below
    `root` holds its limit, a number or "max".
    """
    limits = []
    with suppress(OSError, ValueError):
        for line in groups.read_text(encoding="utf-8").splitlines():
            number, kinds, path = line.split(":", 2)
            if number == "0":
                top, name = root, "memory.max"
            elif "memory" in kinds.split(","):
                top, name = root / "memory", "memory.limit_in_bytes"
            else:
                continue
            place = top / path.lstrip("/")
            for folder in (place, *place.parents):
                if not folder.is_relative_to(top):
                    break
                with suppress(OSError, ValueError):
                    limits.append(int((folder / name).read_text(encoding="utf-8")))
    return limits
