"""Parts of the benchmarks, and what they work with: a folder, data sets, and the commands that they run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from tests.benchmarks.suite.conditions import REPOSITORY

COMMANDS = {
    "vfr-train": "import sys, vfr_bake.cli as c; sys.exit(c.train_main())",
    "vfr-bake": "import sys, vfr_bake.cli as c; sys.exit(c.bake_main())",
    "vfr-eval": "import sys, vfr_bake.cli as c; sys.exit(c.eval_main())",
    "vfr-bench": "import sys, vfr_bake.cli as c; sys.exit(c.bench_main())",
    "vfr-play": "import sys, player.app.cli as c; sys.exit(c.main())",
    "vfr-export": "import sys, exporters.cli as c; sys.exit(c.main())",
}
LITTLE: dict[str, tuple[str, ...]] = {
    "vfr-train": (
        *("--steps", "150", "--n-levels", "6", "--max-resolution", "48", "--log2-table-size", "13"),
        *("--head-width", "24", "--occupancy-resolution", "32", "--batch-samples", "4096"),
    ),
    "vfr-bake": ("--mesh-resolution", "32", "--check-views", "1", "--refine-steps", "20"),
    "vfr-bench": ("--views", "1", "--frames", "2", "--sizes", "24x24", "--samples", "1", "5"),
}
"""Options that are added to a command to try out the machinery."""


class PartError(Exception):
    """Raised if a command of a part fails."""


class Usage(NamedTuple):
    """Time and memory that a command took."""

    seconds: float
    processor_seconds: float
    peak_mb: float


@dataclass
class Work:
    """Folders, data and commands with which a part works."""

    part: str
    root: Path
    """Folder that holds a folder for each part."""
    data_root: Path
    """Folder of the data sets."""
    quick: bool = False
    """True if only the machinery is tried out, with everything as small as possible."""
    commands: list[str] = field(default_factory=list)
    seeds: list[int] = field(default_factory=list)

    @property
    def folder(self) -> Path:
        """Return the folder that the part writes to."""
        return self.root / self.part

    def file(self, part: str, name: str) -> Path:
        """Return the path of a file that another part has written."""
        return self.root / part / name

    def data(self, name: str) -> str:
        """Return the path of a data set, or "demo" for the built-in scene."""
        return name if name == "demo" and not self.quick else str(self.data_root / name)

    def little(self, usual: int | str, quick: int | str) -> str:
        """Return the usual setting, or the one for trying out the machinery."""
        return str(quick if self.quick else usual)

    def command(self, name: str, *arguments: str | Path) -> Usage:
        """Run a command of the package, or the script `name` of this folder. Raises PartError."""
        words = [*map(str, arguments), *(LITTLE.get(name, ()) if self.quick else ())]
        self.commands.append(self.told(name, words))
        print(f"$ {self.commands[-1]}", file=sys.stderr, flush=True)
        begin = ["-c", COMMANDS[name]] if name in COMMANDS else ["-m", f"tests.benchmarks.{name}"]
        start = time.monotonic()
        # As for users: pip writes the bytecode of what it installs.
        environment = os.environ | {"PYTHONDONTWRITEBYTECODE": ""}
        process = subprocess.Popen(
            [sys.executable, *begin, *words], cwd=REPOSITORY, stdout=sys.stderr, env=environment
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise PartError(f"{self.part}: {name} ended with {process.returncode}")
        used = usage.ru_utime + usage.ru_stime
        return Usage(time.monotonic() - start, used, usage.ru_maxrss * 1024 / 1e6)

    def told(self, name: str, words: list[str]) -> str:
        """Return the command as a reader types it, without folders of this machine."""
        shown = " ".join(words).replace(f"{self.root}/", "").replace(f"{self.data_root}/", "")
        return f"{name if name in COMMANDS else f'python -m tests.benchmarks.{name}'} {shown}"

    def read(self, name: str) -> Any:
        """Return the content of a JSON file of the part."""
        return json.loads((self.folder / name).read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Part:
    """One piece of the benchmarks, which is run as a whole or not at all."""

    name: str
    measure: Callable[[Work], dict[str, Any]]
    """Function that returns the figures."""
    minutes: float
    """Approximate minutes on two cores."""
    needs: tuple[str, ...] = ()
    """Parts whose files it reads."""
    data: str | None = None
    """The data set that it reads, beside the files of those parts."""
    core: bool = True
    """Whether `make benchmarks` runs it."""
