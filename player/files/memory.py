"""The memory that a command may take: as much as was asked for, or a share of what there is."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

from player.errors import ConfigError

SHARE = 0.5
"""A share of the machine's memory, or of a lower limit of the process, where no other number is asked for:
the rest is for the program itself, for pictures and for other programs."""
UNKNOWN = 4 << 30
"""Bytes of memory that are assumed where the machine does not tell."""


def allowed_bytes(max_memory: float | None = None) -> int:
    """Bytes that a command may take.

    Args:
        max_memory: gigabytes that were asked for; None is a share of what this process can have.

    Raises ConfigError: not more than 0.

    >>> allowed_bytes(1.5)
    1500000000
    """
    if max_memory is None:
        return int(SHARE * min([*_limits(), _machine_bytes()]))
    if not 0 < max_memory < 1e9:
        raise ConfigError(f"max_memory: expected gigabytes, more than 0, got {max_memory:g}")
    return int(max_memory * 1e9)


def check_memory(needed: int, allowed: int, where: str) -> None:
    """Raise ConfigError if what `where` needs is more than what is allowed."""
    if needed > allowed:
        raise ConfigError(
            f"{where}: memory: expected at most {allowed / 1e9:.3g} GB, got {needed / 1e9:.3g} GB or more "
            "that it takes: allow more by --max-memory"
        )


def give_back() -> None:
    """Hand memory that is free in this process back to the machine.

    glibc keeps what was freed for the thread that had asked for it: all pictures that threads have read,
    where they were copied since. Other C libraries are left to themselves.
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
    """Limits of this process that are lower than the machine: of its address space, of its control groups."""
    limits = []
    with suppress(ImportError, OSError, ValueError):
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_AS)
        if soft != resource.RLIM_INFINITY:
            limits.append(soft)
    return limits + _group_limits(Path("/proc/self/cgroup"), Path("/sys/fs/cgroup"))


def _group_limits(groups: Path, root: Path) -> list[int]:
    """What Linux's control groups say: of the group of this process and of those above it.

    `groups` has a line for each hierarchy, "0::/path" or "5:memory:/path"; a number is in a file, or "max".
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
