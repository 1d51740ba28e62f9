"""Kill commands before every system call that changes something under the folder of their output.

    python -m tests.reliability.every_call            # a run for each call, which is then killed: minutes
    python -m tests.reliability.every_call --once     # one run a command: its folder is copied at each call

Every command replaces an old result. A kill leaves what the folder holds at that call: under each name there
has to be the whole old result or the whole new one. The same command then has to succeed, and to leave no
more files than a run that nobody kills. Files that belong together are compared after the check that every
command makes before it writes.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from exporters.cli import main as export_main
from player.app.cli import main as play_main
from player.asset.asset import Asset
from player.files.replace import MARK, clear_up, mark
from tests.player.conftest import write_shells
from tests.reliability import stops
from tests.reliability.kill import BAKE, SMALL, _write_data, contents, forked
from vfr_bake.cli import bake_main, bench_main, eval_main, train_main
from vfr_bake.training.model_file import load_model
from vfr_bake.training.tensor_files import read_tensors

Check = Callable[[Path], object]
TRAIN = [*SMALL, "--steps", "3", "--checkpoint-minutes", "0.0000001"]


@dataclass(frozen=True)
class Command:
    """A command that replaces the content of a folder of its own."""

    name: str
    main: Callable[[list[str]], int]
    arguments: list[str]
    """Arguments of every run, in which OUT stands for the folder."""
    old: list[str]
    """More arguments for the run that makes the old result, so that it differs from the new one."""
    names: dict[str, Check | None]
    """The names that the command writes, each with a function that raises unless the result is whole; None if
    two runs write the same bytes."""
    together: bool = False
    """True if the results under the names belong together."""
    again: tuple[str, ...] = ()


NAMES = [
    *("train", "bake", "play pictures", "play video", "export ply", "export obj", "export glb", "export usd"),
    *("export colmap", "export exr", "eval", "bench"),
]


def commands(work: Path, names: list[str]) -> list[Command]:
    """Return the commands of `names`, on small scenes."""
    asset, data, model = write_shells(work / "shells"), work / "data", work / "base.pt"
    baked = work / "baked"
    _write_data(data)
    play = [str(asset), "--orbit", "2", "--size", "32x24", "--threads", "1"]
    small = ["--method", "density", "--faces", "100"]
    exr = ["--format", "exr", "--cameras", str(asset / "cameras.json")]

    def prepare() -> int:
        return train_main([str(data), str(model), *SMALL]) or bake_main([str(model), str(baked), *BAKE])

    if {"bake", "eval", "bench"} & set(names) and forked(prepare):
        raise SystemExit("vfr-train or vfr-bake failed")
    bench = [str(baked), "--data", str(data), "--samples", "1", "--sizes", "16x16", "--views", "1"]
    frames = ["frames/orbit_000.png", "frames/orbit_001.png"]

    def export(name: str, target: str, *options: str, more: tuple[str, ...] = (), **settings: Any) -> Command:
        names = dict.fromkeys((target, *more))
        arguments = [str(asset), f"OUT/{target}", *options]
        changed = settings.pop("old", ["--faces", "20"])
        return Command(name, export_main, arguments, changed, names, **settings)

    every = [
        Command("train", train_main, [str(data), "OUT/model.pt", *TRAIN, "--json", "OUT/train.json"],
                ["--steps", "2"], {"model.pt": load_model, "model.pt.checkpoint": _checkpoint,
                                   "train.json": _json}, again=("--resume",)),
        Command("bake", bake_main, [str(model), "OUT/asset", *BAKE, "--json", "OUT/bake.json"],
                ["--resolution", "20"], {"asset": _asset, "bake.json": _json}),
        Command("play pictures", play_main, [*play, "--output", "OUT/frames", "--json", "OUT/play.json"],
                ["--samples", "1"], {**dict.fromkeys(frames), "play.json": _json}),
        Command("play video", play_main, [*play, "--output", "OUT/turn.mp4"], ["--samples", "1"],
                {"turn.mp4": None}),
        export("export ply", "mesh.ply", *small),
        export("export obj", "mesh.obj", *small, "--texture", "256", more=("mesh.mtl", "mesh.png"),
               together=True),
        export("export glb", "mesh.glb", *small, "--lods", "2", more=("mesh.lod1.glb",), together=True),
        export("export usd", "mesh.usdc", *small),
        export("export colmap", "model", "--format", "colmap", "--method", "density", "--points", "50",
               old=["--points", "40"]),
        export("export exr", "layers", *exr, old=["--half"]),
        Command("eval", eval_main,
                [str(model), str(data), "--json", "OUT/eval.json", "--pictures", "OUT/pictures"],
                [], {"eval.json": _json, "pictures/r_0.png": None}),
        Command("bench", bench_main, [*bench, "--frames", "2", "--json", "OUT/bench.json",
                                      "--html", "OUT/bench.html"],
                [], {"bench.json": _json, "bench.html": _page}),
    ]  # fmt: skip
    return [command for command in every if command.name in names]


def _asset(folder: Path) -> None:
    Asset.open(folder, verify=True)


def _json(path: Path) -> None:
    json.loads(path.read_text())


def _page(path: Path) -> None:
    assert path.read_text().rstrip().endswith("</html>")


def _checkpoint(path: Path) -> None:
    read_tensors(path, "a checkpoint")


class Trial:
    """A command, its old and new results, and the states of its folder when it is killed."""

    def __init__(self, command: Command, work: Path) -> None:
        self.command = command
        self._out, self._old, self._new = work / "out", work / "old", work / "new"
        self._copies = work / "copies"
        self._start_from(None)
        self._run([*self.command.old, *self._forced])
        shutil.copytree(self._out, self._old)
        self._run(self._forced)
        shutil.copytree(self._out, self._new)

    @property
    def _forced(self) -> list[str]:
        return [] if self.command.main is eval_main else ["--force"]

    def _start_from(self, folder: Path | None) -> None:
        shutil.rmtree(self._out, ignore_errors=True)
        if folder is None:
            self._out.mkdir(parents=True)
        else:
            shutil.copytree(folder, self._out)
            for left in self._out.glob(f".*/{MARK}"):  # a copy has another inode number
                mark(left.parent)

    def _main(self, more: list[str]) -> int:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        torch.set_num_threads(1)
        arguments = [word.replace("OUT/", f"{self._out}/") for word in self.command.arguments]
        return self.command.main([*arguments, *more])

    def _run(self, more: list[str]) -> None:
        if code := forked(lambda: self._main(more)):
            raise SystemExit(f"{self.command.name} {more}: exit code {code} without a kill")

    def killed(self) -> Iterator[str]:
        """Start a run for every call, kill it there, and yield the call with the folder as it is then."""
        for number in range(1, 10_000):
            self._start_from(self._old)
            calls: list[str] = []

            def at(call: str, number: int = number, calls: list[str] = calls) -> bool:
                calls.append(call)
                return len(calls) == number

            code = stops.run(lambda: self._main(self._forced), self._out, at)
            if code == 0:
                return
            if code != -signal.SIGKILL:
                raise SystemExit(f"{self.command.name}, {calls[-1]}: exit code {code}")
            yield calls[-1]

    def copied(self) -> Iterator[str]:
        """Copy the folder at every call of one run, and yield each call with the folder as it was there."""
        self._start_from(self._old)
        calls: list[str] = []

        def at(call: str) -> bool:
            shutil.copytree(self._out, self._copies / str(len(calls)))
            calls.append(call)
            return False

        if code := stops.run(lambda: self._main(self._forced), self._out, at):
            raise SystemExit(f"{self.command.name}: exit code {code} while it was watched")
        for number, call in enumerate(calls):
            self._start_from(self._copies / str(number))
            yield call
        shutil.rmtree(self._copies, ignore_errors=True)

    def wrong(self, again: bool) -> str | None:
        """Return what is wrong with the folder now or after another run; None if nothing is."""
        with tempfile.TemporaryFile() as said:

            def look() -> int:
                try:
                    self._check()
                    if again:
                        if self._main([*self.command.again, *self._forced]):
                            raise AssertionError("the next run failed")
                        self._check()
                        left = sorted(set(_names(self._out)) - set(_names(self._new)))
                        assert not left, f"left after the next run: {left}"
                except Exception as error:
                    said.write(f"{type(error).__name__}: {error}".encode())
                    said.flush()
                    return 1
                return 0

            code = forked(look)
            said.seek(0)
            return None if code == 0 else said.read().decode() or f"exit code {code}"

    def _check(self) -> None:
        if self.command.together:
            clear_up(self._out)
        states = set()
        for name, whole in self.command.names.items():
            path, old = self._out / name, self._old / name
            if not path.exists():
                assert not old.exists(), f"{name} is gone"
                continue
            now = contents(path)
            if whole is not None:
                whole(path)
            else:
                was, new = contents(old), contents(self._new / name)
                assert now in (was, new), f"{name} is neither the old nor the new one"
                if was != new:
                    states.add(now == new)
        assert not self.command.together or len(states) == 1, "some are old and some are new"


def _names(folder: Path) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in folder.rglob("*")]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--once", action="store_true", help="one run a command, copied at each call")
    parser.add_argument(
        "--again", type=int, default=1, help="run the command again after each N-th call", metavar="N"
    )
    parser.add_argument("--commands", nargs="*", choices=NAMES, default=NAMES)
    options = parser.parse_args()
    result: dict[str, Any] = {"commands": {}, "failures": []}
    with tempfile.TemporaryDirectory(prefix="vfr-calls-") as folder:
        for command in commands(Path(folder).resolve(), options.commands):
            begin = time.monotonic()
            trial = Trial(command, Path(folder).resolve() / "trials" / command.name)
            kinds: collections.Counter[str] = collections.Counter()
            n_again = 0
            for number, call in enumerate(trial.copied() if options.once else trial.killed()):
                kinds[call.split()[0]] += 1
                again = number % options.again == 0 or call.startswith("rename")
                n_again += again
                if wrong := trial.wrong(again):
                    result["failures"].append(f"{command.name}, call {number}, {call}: {wrong}")
            result["commands"][command.name] = {
                "calls": sum(kinds.values()), "run again": n_again,
                "seconds": round(time.monotonic() - begin, 1), "kinds": dict(sorted(kinds.items())),
            }  # fmt: skip
            sys.stderr.write(f"{command.name}: {result['commands'][command.name]}\n")
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 1 if result["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
