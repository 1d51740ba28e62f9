"""Give broken inputs to every reader: each has to be read, or refused with a VfrError, in bounded time and
memory.

    python -m tests.reliability.fuzz --inputs 100000 --seed 0

Input i of a seed is always the same. Each may take LIMIT_SECONDS, and all of them together may take ROOM
bytes more memory than the process had before. It is a failure to open a file outside the work folder, to
start a program or to connect to anything. Arrays of assets are broken while they are unpacked, and get their
checksums in the manifest; heads are also broken in their structure. What can be read is played
(`tests.reliability.fuzz.assets`, `heads`, `data`).

Processes of their own (`worker`) read the inputs: an input that makes one crash or hang is named as a
failure, and a new process goes on with the next input. If `strace` is installed, it also shows which files
native code opens; without it only files that Python opens are seen, and the result says so.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.reliability.fuzz.worker import COUNTS, INDEX, LIMIT_SECONDS, MARK, SLOWEST_US, allowed

STATE_WORDS = 256
TRACED = "open,openat,openat2,creat,execve,execveat,connect"
START_SECONDS = 600.0
"""Seconds after which a worker that has not begun counts as hanging; it compiles kernels at first use."""


class Worker:
    """Reads inputs in one process at a time; after an input that ends it, another process takes over."""

    def __init__(self, work: Path, seed: int, first: int, step: int, n_inputs: int, names: list[str]) -> None:
        self.failures: list[dict[str, Any]] = []
        self.traced = shutil.which("strace") is not None
        self._work, self._seed, self._step = work, seed, step
        self._first, self._n_inputs, self._names = first, n_inputs, names
        work.mkdir()
        (work / "state").write_bytes(bytes(8 * STATE_WORDS))
        self.state = np.memmap(work / "state", np.int64, "r+")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def targets(self) -> list[str]:
        """Return the names of the targets, once a worker has written them."""
        told = [*self._work.glob("targets.json"), *self._work.glob("from_*/targets.json")]
        return json.loads(told[0].read_text()) if told else []

    def _run(self) -> None:
        first = self._first
        while first < self._n_inputs:
            self.state[INDEX] = -1
            folder = self._work / f"from_{first}"
            folder.mkdir()
            os.link(self._work / "state", folder / "state")
            how = self._one(folder, first)
            if (folder / "targets.json").exists():
                shutil.copy(folder / "targets.json", self._work)
            shutil.rmtree(folder, ignore_errors=True)
            at = int(self.state[INDEX])
            if how is None:
                return
            if at < 0:
                self.failures.append({"index": -1, "target": "none", "what": f"no start: {how}"})
                return
            names = self.targets()
            self.failures.append({"index": at, "target": names[at % len(names)], "what": how})
            first = at + self._step

    def _one(self, folder: Path, first: int) -> str | None:
        """Run a worker from input `first` on, and return how it ended; None if it ended well."""
        arguments = [folder, self._seed, first, self._step, self._n_inputs, *self._names]
        command = [sys.executable, "-m", "tests.reliability.fuzz.worker", *map(str, arguments)]
        trace = None
        if self.traced:
            os.mkfifo(folder / "trace")
            trace = threading.Thread(target=self._read_trace, args=(folder,), daemon=True)
            trace.start()
            command = ["strace", "-f", "-qq", "-y", "--seccomp-bpf", "-s", "400", "-e", f"trace={TRACED}",
                       "-e", "signal=none", "-o", str(folder / "trace"), *command]  # fmt: skip
        environment = os.environ | {"VFR_CANARIES": "1"}
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
            start_new_session=True,
        )  # fmt: skip
        hung = threading.Event()
        threading.Thread(target=self._end_if_hung, args=(process, hung), daemon=True).start()
        assert process.stdout is not None and process.stderr is not None
        errors: list[str] = []
        listener = threading.Thread(target=lambda: errors.extend(process.stderr or []), daemon=True)
        listener.start()
        for line in process.stdout:  # line by line, because they are read while it runs
            if line.startswith("{"):
                self.failures.append(json.loads(line))
        code = process.wait()
        listener.join(5)
        if trace is not None:
            trace.join(30)
        if code == 0:
            return None
        last = next((line.strip() for line in reversed(errors) if line.strip()), "no word")
        return "hangs" if hung.is_set() else f"the process ended with {code}: {last[:200]}"

    def _end_if_hung(self, process: subprocess.Popen[str], hung: threading.Event) -> None:
        at, since = -2, time.monotonic()
        while process.poll() is None:
            time.sleep(0.5)
            if (now := int(self.state[INDEX])) != at:
                at, since = now, time.monotonic()
            elif time.monotonic() - since > (3 * LIMIT_SECONDS if at >= 0 else START_SECONDS):
                hung.set()
                os.killpg(process.pid, signal.SIGKILL)
                return

    def _read_trace(self, folder: Path) -> None:
        """Check every file name that is opened between two marks, and the path that it leads to."""
        index, call = None, re.compile(r'(\w+)\(.*?(?:"((?:[^"\\]|\\.)*)")?.*?(?:= \d+<(.*)>)?$')
        with (folder / "trace").open(errors="replace") as lines:
            for line in lines:
                if MARK in line:
                    found = re.search(rf"{MARK}(\w+)", line)
                    index = int(found[1]) if found and found[1].isdigit() else None
                    continue
                if index is None or "resumed>" in line or " +++ " in line:
                    continue
                match = call.search(line.strip().partition(" ")[2])
                names = [name for name in (match[2], match[3]) if name] if match else []
                opens = match is not None and match[1].startswith(("open", "creat"))
                if not opens or not all(allowed(name, str(folder)) for name in names):
                    what = f"system call: {line.strip()[:200]}"
                    self.failures.append({"index": index, "target": "trace", "what": what})


def fuzz(
    n_inputs: int, seed: int, names: list[str] | None = None, jobs: int = 1, progress: Path | None = None
) -> dict[str, Any]:
    """Give `n_inputs` to the readers in turn, and return what became of them. `progress` is a file that is
    kept up to date meanwhile."""
    begin = time.monotonic()
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="vfr-fuzz-", dir=memory if memory.is_dir() else None) as folder:
        workers = [
            Worker(Path(folder) / f"{job}", seed, job, jobs, n_inputs, names or []) for job in range(jobs)
        ]
        while any(worker.alive for worker in workers):
            time.sleep(0.2)
            if progress is not None and int(time.monotonic() - begin) % 30 == 0:
                progress.write_text(json.dumps(_result(workers, seed, begin), indent=1) + "\n")
                time.sleep(1)
        result = _result(workers, seed, begin)
    if progress is not None:
        progress.write_text(json.dumps(result, indent=1) + "\n")
    return result


def _result(workers: list[Worker], seed: int, begin: float) -> dict[str, Any]:
    names = next((worker.targets() for worker in workers if worker.targets()), [])
    sums = np.sum([worker.state[COUNTS : COUNTS + 2 * len(names)] for worker in workers], axis=0)
    failures = sorted((f for worker in workers for f in list(worker.failures)), key=lambda f: f["index"])
    counts = {}
    for index, name in enumerate(names):
        refused, read = map(int, sums[2 * index : 2 * index + 2])
        counts[name] = {"refused": refused, "read": read}
    return {
        "seed": seed,
        "inputs": int(sums.sum()) + len({f["index"] for f in failures if f["target"] != "trace"}),
        "targets": counts,
        "failures": failures[:200],
        "n_failures": len(failures),
        "watched_by": "strace" if workers[0].traced else "Python's audit hook alone: strace is not installed",
        "slowest_s": round(max(int(worker.state[SLOWEST_US]) for worker in workers) / 1e6, 2),
        "seconds": round(time.monotonic() - begin, 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes that read inputs")
    parser.add_argument("--targets", nargs="*")
    parser.add_argument("--progress", type=Path, help="a file that is kept up to date")
    options = parser.parse_args()
    result = fuzz(options.inputs, options.seed, options.targets, options.jobs, options.progress)
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 1 if result["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
