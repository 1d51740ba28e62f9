"""Kill commands at a random moment, let two share an output, and fill the disk.

    python -m tests.reliability.kill --runs 200 --seed 0

Every run is a fork of this process, which has imported everything, so that a kill falls into the work and not
into the imports. Afterwards the name has to hold its old content, whole, or the new result, whole. The same
command then has to succeed (train and play with --resume).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from exporters.cli import main as export_main
from player.app.cli import main as play_main
from player.asset.asset import Asset
from tests.exporters.meshes import read_ply
from tests.player.conftest import write_shells
from vfr_bake.cli import bake_main, train_main
from vfr_bake.training.model_file import load_model

SMALL = [
    *("--n-levels", "4", "--max-resolution", "32", "--log2-table-size", "12", "--device", "cpu"),
    *("--head-width", "16", "--density-width", "16", "--occupancy-resolution", "16"),
    *("--batch-samples", "1024", "--pilot-steps", "5", "--steps", "60", "--eval-views", "1"),
    *("--checkpoint-minutes", "0.001"),
]  # fmt: skip
BAKE = ["--resolution", "24", "--refine-steps", "3", "--mesh-resolution", "16", "--check-views", "1"]
N_PICTURES = 12
PATIENCE = 300.0
"""Seconds after which a command counts as hanging."""


@dataclass(frozen=True)
class Command:
    """A command with an output."""

    name: str
    run: Callable[[list[str]], int]
    arguments: list[str]
    target: Path
    again: list[str]
    """Arguments that are added to go on after a kill."""
    check: Callable[[Path], object]
    """Function that raises unless the output is whole."""


def commands(work: Path, names: list[str]) -> list[Command]:
    """Return the commands of `names`, on small scenes. The model to bake is trained here."""
    asset = write_shells(work / "shells")
    data, model = work / "data", work / "base.pt"
    if {"train", "bake"} & set(names):
        _write_data(data)
    if "bake" in names and forked(lambda: train_main([str(data), str(model), *SMALL])) != 0:
        raise SystemExit("vfr-train failed")
    frames = work / "frames"
    play = [str(asset), *f"--orbit {N_PICTURES} --size 160x120 --threads 1 --output".split(), str(frames)]
    new_model, new_asset, mesh = work / "new.pt", work / "baked", work / "mesh.ply"
    every = [
        Command(
            "train", train_main, [str(data), str(new_model), *SMALL], new_model, ["--resume"], load_model
        ),
        Command("bake", bake_main, [str(model), str(new_asset), *BAKE], new_asset, [], _whole_asset),
        Command("play", play_main, play, frames, ["--resume"], _whole_pictures),
        Command("export", export_main, [str(asset), str(mesh), "--method", "density"], mesh, [], read_ply),
    ]
    return [command for command in every if command.name in names]


def _whole_asset(folder: Path) -> None:
    Asset.open(folder, verify=True)


def _whole_pictures(folder: Path) -> None:
    from PIL import Image

    for path in folder.glob("[!.]*.png"):
        with Image.open(path) as picture:
            picture.load()


def _write_data(folder: Path) -> None:
    """Write the built-in scene, 16 pixels wide, as a NeRF-synthetic folder."""
    from dataclasses import replace

    from PIL import Image

    from player.cameras.transforms import write_cameras
    from vfr_bake.data.demo import demo_views

    for split, views in zip(("train", "test"), demo_views(size=16, n_train=8, n_test=1), strict=True):
        (folder / split).mkdir(parents=True)
        for index, image in enumerate(views.images):
            Image.fromarray(image).save(folder / split / f"r_{index}.png")
        cameras = [replace(c, name=f"./{split}/r_{index}") for index, c in enumerate(views.cameras)]
        (folder / f"transforms_{split}.json").write_bytes(write_cameras(cameras))


def start(work: Callable[[], int]) -> int:
    """Run `work` in a fork, and return its process id."""
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        torch.set_num_threads(1)
        code = work()
    finally:
        os._exit(code)


def end(child: int, kill_after: float | None = None) -> int:
    """Wait for a fork, killing it after a time if given. Return its exit code, or minus the signal."""
    begin = time.monotonic()
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        passed = time.monotonic() - begin
        if done:
            return os.waitstatus_to_exitcode(status)
        if (kill_after is not None and passed >= kill_after) or passed > PATIENCE:
            os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
            return -signal.SIGKILL if passed <= PATIENCE else -1000
        time.sleep(0.002)


def forked(work: Callable[[], int]) -> int:
    return end(start(work))


def contents(path: Path) -> dict[str, str]:
    """Return the checksums of what is under a name, by file."""
    if path.is_file():
        return {"": hashlib.sha256(path.read_bytes()).hexdigest()}
    return {
        str(p.relative_to(path)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(path.rglob("*"))
        if p.is_file() and not p.name.startswith(".")
    }


def kill_runs(every: list[Command], n_runs: int, seed: int) -> dict[str, Any]:
    """Kill the commands in turn; the first round and every third one replace an old result, with --force."""
    random = np.random.default_rng(seed)
    tally = {c.name: {"runs": 0, "killed": 0, "old kept": 0, "new there": 0, "none yet": 0} for c in every}
    failures: list[str] = []
    usual = {}
    for command in every:
        begin = time.monotonic()
        if code := forked(lambda command=command: command.run([*command.arguments, "--force"])):
            failures.append(f"{command.name}: exit code {code} without a kill")
        usual[command.name] = time.monotonic() - begin
    for index in range(n_runs):
        command = every[index % len(every)]
        counts = tally[command.name]
        over_old = (index // len(every)) % 3 == 0
        if not over_old:
            _remove(command.target)
        before = contents(command.target) if command.target.exists() else None
        force = ["--force"] if over_old else []
        child = start(lambda c=command, f=force: c.run([*c.arguments, *f]))
        code = end(child, float(random.uniform(0, 0.8 * usual[command.name])))
        counts["runs"] += 1
        counts["killed"] += code == -signal.SIGKILL
        where = f"run {index}, {command.name}, over {'the old' if over_old else 'nothing'}, code {code}"
        if code not in (0, -signal.SIGKILL):
            failures.append(f"{where}: expected to be killed or to end well")
        after = contents(command.target) if command.target.exists() else None
        state = "none yet" if after is None else "old kept" if after == before else "new there"
        counts[state] += 1
        if over_old and after is None:
            failures.append(f"{where}: the old result is gone")
        try:
            if after is not None:
                command.check(command.target)
            again = ["--force"] if command.target.exists() and "--resume" not in command.again else []
            more = command.again if not over_old else ["--force"]
            code = forked(lambda c=command, m=(more or again): c.run([*c.arguments, *m]))
            is_trained = command.name == "train" and after is not None and more == ["--resume"]
            if code and not (code == 1 and is_trained):  # a model that is there is not replaced
                failures.append(f"{where}: exit code {code} when it is run again")
            command.check(command.target)
            n_pictures = len(list(command.target.glob("[!.]*.png")))
            if command.name == "play" and n_pictures != N_PICTURES:
                failures.append(f"{where}: expected {N_PICTURES} pictures, got {n_pictures}")
        except Exception as error:
            failures.append(f"{where}: {type(error).__name__}: {error}")
    return {"usual_s": {k: round(v, 2) for k, v in usual.items()}, "killed": tally, "failures": failures}


def _remove(path: Path) -> None:
    import shutil

    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    for left in path.parent.glob(f".{path.name}*"):
        shutil.rmtree(left) if left.is_dir() else left.unlink()
    for left in path.parent.glob(f"{path.name}.checkpoint*"):
        left.unlink()


def both_at_once(every: list[Command], n_runs: int) -> list[str]:
    """Run a command twice at once: each has to succeed or say why not, and the output has to be whole."""
    failures = []
    for index in range(n_runs):
        command = every[index % len(every)]
        children = [start(lambda c=command: c.run([*c.arguments, "--force"])) for _ in range(2)]
        codes = [end(child) for child in children]
        try:
            if not set(codes) <= {0, 1} or codes == [1, 1]:
                failures.append(f"two at once, {command.name}: exit codes {codes}")
            command.check(command.target)
        except Exception as error:
            failures.append(f"two at once, {command.name}: {type(error).__name__}: {error}")
    return failures


def full_disk(every: list[Command], limits: list[int]) -> list[str]:
    """Limit the length of files, as on a full disk: exit code 1 is expected, and the old result."""
    failures = []
    for command in every:
        for limit in limits:
            before = contents(command.target)

            def limited(c: Command = command, limit: int = limit) -> int:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
                return c.run([*c.arguments, "--force"])

            code = forked(limited)
            if code != 1:
                failures.append(f"files of {limit} bytes at most, {command.name}: expected 1, got {code}")
            if command.name != "play" and contents(command.target) != before:
                failures.append(f"files of {limit} bytes at most, {command.name}: the old result has changed")
            command.check(command.target)
    return failures


def small_disk(every: list[Command], work: Path, sizes: list[str]) -> list[str]:
    """Write the outputs to a tmpfs that is too small. This needs the right to mount one."""
    failures = []
    place = work / "disk"
    place.mkdir()
    for command in every:
        for size in sizes:
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(place)], check=True)
            try:
                target = place / command.target.name
                arguments = [str(target) if a == str(command.target) else a for a in command.arguments]
                code = forked(lambda c=command, a=arguments: c.run(a))
                left = [path.name for path in place.iterdir()]
                if code != 1 or (command.name != "play" and target.name in left):
                    failures.append(f"a disk of {size}, {command.name}: code {code}, left {left}")
                if command.name == "play" and target.exists():
                    command.check(target)
            finally:
                subprocess.run(["umount", str(place)], check=True)
    return failures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--twice", type=int, default=8, help="runs of two commands at once")
    parser.add_argument("--limits", type=int, nargs="*", default=[100, 2000], help="bytes a file, full disk")
    parser.add_argument("--disks", nargs="*", default=[], help="sizes of a tmpfs, for example 8k 64k")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="*", default=["train", "bake", "play", "export"])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="vfr-kill-") as folder:
        work = Path(folder)
        every = commands(work, options.commands)
        result = kill_runs(every, options.runs, options.seed)
        result["failures"] += both_at_once(every, options.twice)
        result["failures"] += full_disk(every, options.limits)
        result["failures"] += small_disk(every, work, options.disks)
    result |= {"two at once": options.twice, "full disk": len(every) * len(options.limits),
               "small disks": len(every) * len(options.disks)}  # fmt: skip
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 1 if result["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
