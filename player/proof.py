"""Check, before work that takes long, that compiled code runs on this processor and computes what it should.

LLVM ends a process that asks it for an instruction which the processor does not have, and the processor ends
a process that runs such an instruction: neither can be caught. So a separate process compiles everything that
is written with explicit vectors, and compares its results with numpy. The compiled code is kept for later
use, and the verdict is kept beside it: the check runs once for these sources, these versions and this
processor. Where compiled code is wrong, marches run in numpy and heads in onnxruntime, which give the same
pictures, more slowly.
"""

from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from player.child import python_command
from player.compiling import SOURCES, available, first_use, not_kept

RIGHT, WRONG = "right", "wrong: "
DEADLY = ("SIGABRT", "SIGILL", "SIGSEGV", "SIGBUS", "SIGFPE", "SIGTRAP")
"""Signals that end a process which runs wrong code. Any other end says nothing about the code."""
DEADLY_ON_WINDOWS = (
    *(3, 0x80000003),  # abort, breakpoint
    *(0xC0000005, 0xC000001D, 0xC0000096),  # access violation, illegal and privileged instruction
    *(0xC0000094, 0xC000008E, 0xC00000FD),  # division by zero of integers and floats, stack overflow
    *(0xC0000374, 0xC0000409),  # damaged heap, damaged stack
)
"""Exit codes of the same ends on Windows. Ctrl-C, for example, ends a process with 0xC000013A."""
_verdicts: dict[Path | None, str] = {}


def prove(say: Any) -> None:
    """Check compiled code, if that was not done before; takes at most a minute.

    Args:
        say: called with a line for people before the check takes long, and if something is wrong.
    """
    if not available():
        return
    if (reason := not_kept()) is not None:
        say(reason)
    known = _known()
    if known is None:
        known = _asked(say)
    if known is not None and known.startswith(WRONG):
        say(
            f"compiled code does not run on this processor ({known[len(WRONG) :]}): "
            "going on with numpy and onnxruntime, which are slower"
        )


def refuted() -> bool:
    """Return whether compiled code was found to be wrong on this processor."""
    known = _known()
    return known is not None and known.startswith(WRONG)


def _known() -> str | None:
    record = _record()
    if record not in _verdicts and record is not None:
        with suppress(OSError, UnicodeDecodeError):
            _verdicts[record] = record.read_text(encoding="utf-8")
    return _verdicts.get(record)


def _record() -> Path | None:
    """Return the file of the verdict; None if nothing can be kept."""
    from player.compiled.processor import target
    from player.kept_code import place

    folder = place(SOURCES).folder
    key = hashlib.sha256(repr(target()).encode()).hexdigest()[:16]
    return None if folder is None else folder / f"proof-{key}.txt"


def _asked(say: Any) -> str | None:
    """Ask a separate process for the verdict; None if it has not given one."""
    if getattr(sys, "frozen", False):  # in a frozen program, sys.executable is no Python
        return None
    if first_use() and sys.stderr.isatty():
        say("compiling for this processor: up to a minute, once")
    try:
        done = subprocess.run(
            python_command("player.proof"), stdin=subprocess.DEVNULL, capture_output=True, text=True
        )
    except OSError:
        return None
    found = (done.stdout.strip().splitlines() or [""])[-1]
    if (died := _deadly(done.returncode)) is not None:
        said = done.stderr.strip().splitlines()
        found = f"{WRONG}{died}{': ' + said[-1][:200] if said else ''}"
    if found != RIGHT and not found.startswith(WRONG):
        return None
    record = _record()
    _verdicts[record] = found
    if record is not None:
        with suppress(OSError):
            record.write_text(found, encoding="utf-8")
    return found


def _deadly(code: int) -> str | None:
    """Return the name of what ended a process, if wrong code ends processes in that way; else None."""
    if sys.platform == "win32":
        return f"exit code {code:#x}" if code in DEADLY_ON_WINDOWS else None
    return next((name for name in DEADLY if getattr(signal, name, None) == -code), None)


def verdict() -> str:
    """Return RIGHT, or WRONG and what is wrong. LLVM or the processor may end this process."""
    from player.compiled import march as march_compiled
    from player.head import proof as proof_head
    from player.march import march

    for name, contracted in (("the march", False), ("the contracted march", True)):
        grid, rays = _grid(contracted), _rays()
        for k in (0, 3):
            got, expected = march_compiled.march(grid, *rays, k), march.march(grid, *rays, k)
            alike = all(
                ours.shape == theirs.shape and np.allclose(ours, theirs, rtol=1e-4, atol=2e-3)
                for ours, theirs in zip(got, expected, strict=True)
            )
            if not alike or not len(expected.hits):
                return f"{WRONG}{name} gives other pictures than numpy"
    wrong = proof_head.wrong()
    return RIGHT if wrong is None else WRONG + wrong


def _grid(contracted: bool) -> Any:
    """Make a grid of two levels, one beside the other, with codes and features that vary; some cells are not
    live."""
    from player.asset.bricks import pack_vertices
    from player.asset.grid import build_grid
    from player.asset.pyramid import Bricks, PyramidValues, whole_pyramid
    from player.march.contracted import MAX_SPEED

    leaves = []
    for level, (low, high) in enumerate(((0, 8), (4, 8))):
        n_cells = 15 >> level
        cells = np.argwhere(np.ones((high - low, n_cells, n_cells))) + np.array([low, 0, 0])
        leaves.append(Bricks(*pack_vertices(cells[(cells * (5, 3, 1)).sum(axis=1) % 29 != 0])[:2]))
    pyramid = whole_pyramid(15, leaves)
    codes, features = [], []
    for level, vertices in enumerate(pyramid.vertices):
        x, y, z = vertices.index.T << level
        codes.append((120 + 8 * x - 5 * y + 3 * z).astype(np.uint8)[:, None])
        features.append(np.stack([x * 8 - 60, y * 7 - 50, z * 5 - (x * y) // 4], axis=-1).astype(np.int8))
    half = 2.0 if contracted else 1.0
    box = np.array([[-half] * 3, [half] * 3])
    step = 4 / 48 / float(MAX_SPEED) if contracted else 0.05
    densities, stored = (PyramidValues(pyramid, tuple(values)) for values in (codes, features))
    return build_grid(densities, stored, box, step, (1, 2), (-3.0, 4.0), contracted)


def _rays() -> tuple[np.ndarray, np.ndarray]:
    angle = np.arange(45) * 0.7
    rays_o = 1.4 * np.stack([np.cos(angle), np.sin(angle), np.cos(angle * 0.3)], axis=-1)
    rays_d = 0.3 * np.stack([np.sin(angle * 3), np.cos(angle * 5), np.sin(angle * 2)], axis=-1) - rays_o
    rays_d /= np.linalg.norm(rays_d, axis=-1, keepdims=True)
    return rays_o.astype(np.float32), rays_d.astype(np.float32)


if __name__ == "__main__":
    sys.stdout.write(verdict() + "\n")
