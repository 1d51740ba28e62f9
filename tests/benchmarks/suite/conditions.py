"""Conditions under which something is measured: machine, load, commit and versions. Linux alone."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

REPOSITORY = Path(__file__).resolve().parents[3]
MEASURED = ("player", "exporters", "vfr_bake", "constraints.txt")
"""Paths on which figures depend: a later commit that does not change these leaves the figures valid."""
FEATURES = (
    *("sse4_2", "avx", "avx2", "fma", "f16c", "avx512f", "avx512bw", "avx512vl", "avx512_vnni", "avx_vnni"),
    *("avx512_bf16", "amx_int8", "asimd", "asimddp", "i8mm", "sve"),
)
"""Processor features that compiled code or a library uses."""
LIBRARIES = (
    *("numpy", "numba", "llvmlite", "onnxruntime", "torch", "scipy", "Pillow", "opencv-python-headless"),
    *("pycolmap", "scikit-image", "open3d-cpu", "playwright"),
)
QUIET = 0.05
"""Largest share of all processors that other programs may take on a machine that counts as quiet."""
LOOK = 5.0
"""Seconds for which the load is observed."""


class BusyError(Exception):
    """Raised if other programs kept the machine busy for all of the time to wait."""


class Ticks(NamedTuple):
    """Seconds of all processors together since the machine was started."""

    busy: float
    total: float


def parse_ticks(stat: str, ticks_a_second: int) -> Ticks:
    """Parse the first line of /proc/stat. Time that a hypervisor gave to others counts as busy.

    >>> parse_ticks("cpu  100 0 50 700 50 0 0 100 0 0", 100)
    Ticks(busy=2.5, total=10.0)
    """
    user, nice, system, idle, waiting, *others = map(int, stat.split()[1:9])
    busy = user + nice + system + sum(others)
    return Ticks(busy / ticks_a_second, (busy + idle + waiting) / ticks_a_second)


def ticks() -> Ticks:
    with Path("/proc/stat").open(encoding="ascii") as stat:
        return parse_ticks(stat.readline(), os.sysconf("SC_CLK_TCK"))


def adopt_orphans() -> None:
    """Make this process the parent of processes that its children leave behind from now on.

    A browser leaves behind the process that draws, whose time would count as another program's.
    """
    subreaper = 36  # PR_SET_CHILD_SUBREAPER
    if ctypes.CDLL(None).prctl(subreaper, 1, 0, 0, 0):
        raise OSError("prctl: expected to become a subreaper, was refused")


def bury_orphans() -> None:
    """Wait, for a few seconds at most, until all adopted processes have ended. From then on their time counts
    as this process's time."""
    until = time.monotonic() + LOOK
    try:
        while time.monotonic() < until:
            if not os.waitpid(-1, os.WNOHANG)[0]:
                time.sleep(0.05)
    except ChildProcessError:
        pass


class OthersClock:
    """Measures the share of all processors that other programs take from now on. The time of a child of this
    process is known when the child has ended."""

    def __init__(self) -> None:
        self._ticks, self._own = ticks(), self._seconds()

    @staticmethod
    def _seconds() -> float:
        return sum(os.times()[:4])

    def share(self) -> float:
        now, own = ticks(), self._seconds()
        total = now.total - self._ticks.total
        others = (now.busy - self._ticks.busy) - (own - self._own)
        return max(others / total, 0.0) if total > 0 else 0.0


def others_now() -> float:
    """Return the share that other programs take while this one waits."""
    clock = OthersClock()
    time.sleep(LOOK)
    return clock.share()


def wait_until_quiet(
    minutes: float,
    anyway: bool,
    say: Callable[[str], object],
    look: Callable[[], float] = others_now,
    now: Callable[[], float] = time.monotonic,
) -> float:
    """Wait for a quiet machine, and return the share that other programs take.

    Args:
        minutes: to wait at most.
        anyway: go on after that even if the machine is busy.
        say: gets a line for the user at every look.
        look: measures the share.
        now: returns seconds of a clock.

    Raises BusyError if the machine is busy for all of that time, unless `anyway`.
    """
    begin = now()
    while (share := look()) > QUIET:
        waited = (now() - begin) / 60
        if waited >= minutes:
            if anyway:
                say(f"other programs take {share:.0%} of the processors: measured beside them, as asked")
                return share
            raise BusyError(
                f"processors: expected other programs to take at most {QUIET:.0%} of them, got {share:.0%} "
                f"after {round(waited, 1):g} minutes: end them, or give --wait more, or --busy-anyway"
            )
        say(
            f"other programs take {share:.0%} of the processors: waiting, {waited:.1f} of {minutes:g} minutes"
        )
    return share


def parse_machine(cpuinfo: str, meminfo: str) -> dict[str, Any]:
    """Return the description of the machine that is recorded, from the texts of /proc/cpuinfo and
    /proc/meminfo.

    >>> cpuinfo = "processor: 0\\nmodel name: AMD EPYC\\ncpu family: 26\\nmodel: 2\\nflags: fpu avx2 fma\\n"
    >>> parse_machine(cpuinfo, "MemTotal: 25165824 kB")["processor"]
    'AMD EPYC (family 26, model 2)'
    """
    fields: dict[str, str] = {}
    for line in cpuinfo.splitlines():
        key, _, value = line.partition(":")
        fields.setdefault(key.strip(), value.strip())
    flags = (fields.get("flags") or fields.get("Features") or "").split()
    name = fields.get("model name") or platform.machine()
    if "cpu family" in fields:
        name += f" (family {fields['cpu family']}, model {fields['model']})"
    kilobytes = re.search(r"MemTotal:\s+(\d+)", meminfo)
    return {
        "processor": name,
        "features": [feature for feature in FEATURES if feature in flags],
        "cores": os.cpu_count(),
        "memory_gb": round(int(kilobytes[1]) / 2**20) if kilobytes else None,
    }


def machine() -> dict[str, Any]:
    texts = (Path(f"/proc/{name}").read_text(encoding="utf-8") for name in ("cpuinfo", "meminfo"))
    return parse_machine(*texts)


def libraries() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def commit() -> str:
    """Return the last commit that changed something under the paths MEASURED."""
    return _git("log", "-1", "--format=%h", "--abbrev=10", "--", *MEASURED).strip()


def changed_files() -> list[str]:
    """Return the files under the paths MEASURED that differ from the commit."""
    return [line[3:] for line in _git("status", "--porcelain", "--", *MEASURED).splitlines()]


def _git(*arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], cwd=REPOSITORY, capture_output=True, text=True, encoding="utf-8", check=False
    )
    if done.returncode:
        sys.exit(f"git {arguments[0]}: expected a checkout, got: {done.stderr.strip()}")
    return done.stdout
