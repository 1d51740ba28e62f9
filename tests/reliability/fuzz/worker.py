"""Process that reads the inputs. It may crash; its state then shows at which input.

    python -m tests.reliability.fuzz.worker WORK SEED FIRST STEP N NAMES...

Reads the inputs FIRST, FIRST + STEP, ... below N. Writes to WORK/state which input it is at and what became
of the earlier ones, and a line of JSON to stdout for each failure.
"""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from exporters.formats.ply import ply_bytes
from exporters.shapes.mesh import TriangleMesh
from player.errors import VfrError
from tests.player.conftest import cameras_bytes, head_bytes
from tests.reliability.fuzz.assets import BrokenAsset, asset_targets, whole_asset
from tests.reliability.fuzz.data import camera_targets, colmap_targets, model_target, picture_target
from tests.reliability.fuzz.heads import head_targets
from tests.reliability.fuzz.parts import parts_targets, whole_parts
from tests.reliability.fuzz.sections import section_targets
from tests.reliability.fuzz.targets import Target, written

LIMIT_SECONDS = 20.0
ROOM = 3 << 30
N_FIRST = 12
"""Number of inputs that each reader gets before the watch begins."""
MARK = "/vfr-fuzz-input/"
"""Path of no file that is opened before and after each input, to mark the input in a trace of calls."""
INDEX, SLOWEST_US, COUNTS = 0, 1, 2
"""Places in the state: the current input, microseconds of the slowest one, then the numbers of refused and of
read inputs for each target."""


class SlowError(BaseException):
    """Raised if an input takes longer than LIMIT_SECONDS; not an Exception, so that no reader catches it."""


class Watch:
    """Notes the files that Python opens and the programs that it starts while a reader works."""

    def __init__(self, inside: Path) -> None:
        self.wrong: list[str] = []
        self.on = False
        self._inside = str(inside)
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple) -> None:
        if not self.on:
            return
        if event == "open" and isinstance(arguments[0], str | bytes):
            name = os.fsdecode(arguments[0])
            if not allowed(name, self._inside):
                self.wrong.append(f"opened {name!r}")
        elif event in ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "pickle.find_class",
                       "socket.connect"):  # fmt: skip
            self.wrong.append(f"{event} {arguments[:1]!r}")


INSTALLED = tuple(
    {sys.prefix, sys.base_prefix, str(Path(np.__file__).parent.parent), str(Path(__file__).parents[3])}
)
SYSTEM = ("/lib", "/usr/lib", "/etc/ld.so", "/etc/localtime", "/sys/", "/proc/self/cgroup", "/proc/self/maps",
          "/proc/self/statm", "/proc/stat", "/proc/cpuinfo", "/proc/meminfo", "/proc/sys/vm/", "/dev/urandom",
          MARK)  # fmt: skip


def allowed(name: str, inside: str) -> bool:
    """Return whether a reader may open a file of this name: one of an installed package, of the system, or in
    the work folder."""
    name = re.sub(r"^/proc/\d+/", "/proc/self/", name)
    return not name.startswith("/") or name.startswith((inside, *INSTALLED, *SYSTEM))


def targets(work: Path) -> list[Target]:
    """Return all targets, with their files in `work`."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = TriangleMesh(
        corners, np.array([[0, 1, 2]], np.int32), np.eye(3, dtype=np.float32), np.full((3, 4), 255, np.uint8)
    )
    head = head_bytes()
    whole = whole_asset(work / "whole", head, ply_bytes(mesh), cameras_bytes(2))
    return [
        *asset_targets(BrokenAsset(whole, work / "asset")),
        *parts_targets(BrokenAsset(whole_parts(work / "whole_parts", whole), work / "parts")),
        *camera_targets(work),
        *colmap_targets(work),
        *head_targets(work, head),
        *section_targets(),
        picture_target(work),
        model_target(work),
    ]


def outcome(target: Target) -> str:
    """Return "refused" for a VfrError of one line that names each place once, "read", or what is wrong."""
    signal.setitimer(signal.ITIMER_REAL, LIMIT_SECONDS)
    try:
        target.read()
    except VfrError as error:
        text = str(error)
        if "\n" in text or len(text) >= 3000:
            return f"not one short line: {text[:200]!r}"
        return f"says a place twice: {text[:200]!r}" if said_twice(text) else "refused"
    except SlowError:
        return f"over {LIMIT_SECONDS:g} s"
    except BaseException as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return "read"


def said_twice(message: str) -> bool:
    """Return whether a file or a field is named twice in a message *where: what: expected, got*.

    >>> said_twice("out/head.onnx: expected a graph, got: head.onnx: expected a message")
    True
    >>> said_twice("m.json: files: a: bytes: expected an integer, got 'a'")
    False
    >>> said_twice("a.npy: expected a numpy array, got b'x: y x: y: z'")
    False
    """
    message = re.sub(r"""\bb(['"]).*\1""", "bytes", message)  # a file's own bytes may say anything
    names = [part.replace("\\", "/").rsplit("/", 1)[-1] for part in message.split(": ")[:-1]]
    places = [name for name in names if re.fullmatch(r"[\w.-]*[A-Za-z][\w.-]*", name)]
    return len(places) != len(set(places))


def _too_slow(*_: object) -> None:
    raise SlowError


def _mark(text: str) -> None:
    try:
        os.open(f"{MARK}{text}", os.O_RDONLY)
    except OSError:
        pass


def main(work: Path, seed: int, first: int, step: int, n_inputs: int, names: list[str]) -> None:
    """Read all inputs of this worker."""
    chosen = [target for target in targets(work) if not names or target.name in names]
    written(work / "targets.part", json.dumps([target.name for target in chosen]).encode()).replace(
        work / "targets.json"
    )
    state = np.memmap(work / "state", np.int64, "r+")
    watch = Watch(work)
    signal.signal(signal.SIGALRM, _too_slow)
    for target in chosen:  # imports and compiles what is needed at first use
        for index in range(N_FIRST):
            target.prepare(np.random.default_rng([index]))
            outcome(target)
    if sys.platform == "linux":
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, resource.RLIM_INFINITY))
    for index in range(first, n_inputs, step):
        which = index % len(chosen)
        target = chosen[which]
        state[INDEX] = index
        target.prepare(np.random.default_rng([seed, index]))
        start = time.process_time()
        _mark(f"{index}")
        watch.on = True
        what = outcome(target)
        watch.on = False
        _mark("end")
        state[SLOWEST_US] = max(int(state[SLOWEST_US]), int(1e6 * (time.process_time() - start)))
        if watch.wrong:
            what, watch.wrong = "; ".join(watch.wrong[:3]), []
        if what in ("refused", "read"):
            state[COUNTS + 2 * which + (what == "read")] += 1
        else:
            report: dict[str, Any] = {"index": index, "target": target.name, "what": what}
            sys.stdout.write(json.dumps(report) + "\n")
            sys.stdout.flush()
    state[INDEX] = n_inputs


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:6]), sys.argv[6:])
