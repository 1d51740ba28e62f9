"""Stops a process before every system call that changes something under a folder, by ptrace and seccomp.

The kernel stops the process, and every process that it starts, before it carries out such a call, no matter
whether Python, a C library or a thread makes the call. Only the calls in `CALLS` are slowed down.
"""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

# For each name, the call's numbers on x86_64 and aarch64, and where its paths are: (argument of the folder's
# handle or None, argument of the path or None for the handle's own file)
CALLS: dict[str, tuple[int | None, int | None, list[tuple[int | None, int | None]]]] = {
    "write": (1, 64, [(0, None)]),
    "pwrite64": (18, 68, [(0, None)]),
    "writev": (20, 66, [(0, None)]),
    "pwritev": (296, 70, [(0, None)]),
    "sendfile": (40, 71, [(0, None)]),
    "copy_file_range": (326, 285, [(2, None)]),
    "ftruncate": (77, 46, [(0, None)]),
    "fallocate": (285, 47, [(0, None)]),
    "fchmod": (91, 52, [(0, None)]),
    "truncate": (76, 45, [(None, 0)]),
    "open": (2, None, [(None, 0)]),
    "openat": (257, 56, [(0, 1)]),
    "creat": (85, None, [(None, 0)]),
    "mkdir": (83, None, [(None, 0)]),
    "mkdirat": (258, 34, [(0, 1)]),
    "rmdir": (84, None, [(None, 0)]),
    "unlink": (87, None, [(None, 0)]),
    "unlinkat": (263, 35, [(0, 1)]),
    "rename": (82, None, [(None, 0), (None, 1)]),
    "renameat": (264, 38, [(0, 1), (2, 3)]),
    "renameat2": (316, 276, [(0, 1), (2, 3)]),
    "link": (86, None, [(None, 1)]),
    "linkat": (265, 37, [(2, 3)]),
    "symlink": (88, None, [(None, 1)]),
    "symlinkat": (266, 36, [(1, 2)]),
    "chmod": (90, None, [(None, 0)]),
    "fchmodat": (268, 53, [(0, 1)]),
    "fchmodat2": (452, 452, [(0, 1)]),
}
_COLUMN = ["x86_64", "aarch64"].index(platform.machine())
_NUMBERS = {entry[_COLUMN]: name for name, entry in CALLS.items() if entry[_COLUMN] is not None}
_TRACEME, _CONT, _SETOPTIONS, _SYSCALL_INFO = 0, 7, 0x4200, 0x420E
_OPTIONS = (
    0x2 | 0x4 | 0x8 | 0x10 | 0x80 | 0x100000
)  # fork, vfork, clone, exec, seccomp; killed with the tracer
_SECCOMP_STOP = 7
_AT_FDCWD = (1 << 32) - 100
_WALL = 0x40000000
_libc = ctypes.CDLL(None, use_errno=True)


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


def _ptrace(request: int, pid: int = 0, address: int = 0, data: object = None) -> None:
    if _libc.ptrace(ctypes.c_long(request), pid, ctypes.c_void_p(address), data) < 0 and request != _CONT:
        raise OSError(ctypes.get_errno(), f"ptrace {request}")


def _ask_to_be_stopped() -> None:
    """Install a filter, in the process itself, that shows the calls to the tracer; stop before that."""
    numbers = list(_NUMBERS)
    code = [(0x20, 0, 0, 0)]  # the number of the call
    code += [(0x15, len(numbers) - index, 0, number) for index, number in enumerate(numbers)]
    code += [(0x06, 0, 0, 0x7FFF0000), (0x06, 0, 0, 0x7FF00000)]  # allow; tell the tracer
    data = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *line) for line in code))
    program = _Program(len(code), ctypes.addressof(data))
    _ptrace(_TRACEME)
    os.kill(os.getpid(), signal.SIGSTOP)
    if _libc.prctl(38, 1, 0, 0, 0) or _libc.prctl(22, 2, ctypes.byref(program), 0, 0):
        raise OSError(ctypes.get_errno(), "seccomp")


def run(work: Callable[[], int], folder: Path, stop: Callable[[str], bool]) -> int:
    """Run `work` in a fork, and return its exit code, or minus the signal.

    Before each call that changes something under `folder`, `stop` is called with the call's name and paths.
    It returns whether the process is killed there.
    """
    child = os.fork()
    if not child:
        code = 99
        try:
            _ask_to_be_stopped()
            code = work()
        finally:
            os._exit(code)
    os.waitpid(child, _WALL)
    _ptrace(_SETOPTIONS, child, 0, ctypes.c_void_p(_OPTIONS))
    _ptrace(_CONT, child)
    known = {child}
    while True:
        pid, status = os.waitpid(-1, _WALL)
        known.add(pid)
        if os.WIFEXITED(status) or os.WIFSIGNALED(status):
            if pid == child:
                return os.waitstatus_to_exitcode(status)
            continue
        passed = 0
        if status >> 16 == _SECCOMP_STOP:
            call = _changes(pid, str(folder) + os.sep)
            if call is not None and stop(call):
                for other in known:
                    with suppress(ProcessLookupError):
                        os.kill(other, signal.SIGKILL)
                continue
        elif status >> 16 == 0 and os.WSTOPSIG(status) != signal.SIGSTOP:
            passed = os.WSTOPSIG(status)
        _ptrace(_CONT, pid, 0, ctypes.c_void_p(passed))


def _changes(pid: int, folder: str) -> str | None:
    """Return the call that a process is about to make, if the call changes something under the folder."""
    buffer = ctypes.create_string_buffer(88)
    _ptrace(_SYSCALL_INFO, pid, len(buffer), buffer)
    number, *arguments = struct.unpack_from("7Q", buffer, 24)
    name = _NUMBERS[number]
    flags = {"open": 1, "openat": 2}.get(name)
    if flags is not None and not arguments[flags] & (os.O_CREAT | os.O_TRUNC):
        return None
    paths = [_path(pid, arguments, *place) for place in CALLS[name][2]]
    named = [path.removeprefix(folder) for path in paths if path.startswith(folder)]
    return f"{name} {' '.join(named)}" if named else None


def _path(pid: int, arguments: list[int], handle: int | None, name: int | None) -> str:
    base = f"/proc/{pid}/cwd"
    if handle is not None and arguments[handle] & 0xFFFFFFFF != _AT_FDCWD:
        base = f"/proc/{pid}/fd/{arguments[handle] & 0xFFFFFFFF}"
    try:
        base = str(Path(base).readlink())
    except OSError:
        return ""
    if name is None:
        return base
    with Path(f"/proc/{pid}/mem").open("rb", buffering=0) as memory:
        memory.seek(arguments[name])
        text = memory.read(4096).split(b"\0")[0]
    return os.path.normpath(Path(base, os.fsdecode(text)))
