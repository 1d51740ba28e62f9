"""Where the time of a training step goes, and how much faster it is than in another version.

    python tests/benchmarks/bench_training_step.py lego/ --begin 1200 --threads 1
    python tests/benchmarks/bench_training_step.py lego/ --against ../before

A process for each version trains with default settings up to step `--begin`. Then they take turns of a few
steps, so that other work of the machine affects all of them alike. Figures are medians over the turns. Parts
are timed by the thread that calls them. Compiling in the first steps is in no figure. On two threads
(`--threads 2`) the next step is drawn and sampled beside the loss, so that the parts add up to more than the
step.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

_WORKER = """
import json, sys, time
from pathlib import Path
from collections import Counter
from vfr_bake.config import TrainConfig
from vfr_bake.data import load_scene
from vfr_bake.training.trainer import Trainer
data, begin, settings = sys.argv[1], int(sys.argv[2]), json.loads(sys.argv[3])
config = TrainConfig(device="cpu", minutes=1e6, steps=10**7, **settings)
trainer = Trainer(load_scene(data, downscale=int(sys.argv[4])), config)
spent = Counter()

def timed(owner, name, part):
    function = getattr(owner, name)
    def call(*arguments, **named):
        wall = time.perf_counter()
        try:
            return function(*arguments, **named)
        finally:
            spent[part] += time.perf_counter() - wall
    setattr(owner, name, call)

steps = trainer.run()
for _ in range(begin):
    next(steps)
guide = trainer._guide
timed(guide, "prepare", "occupancy grid, or what guides proposals")
timed(guide, "sample", "sampling")
timed(trainer, "_draw", "drawing rays")
timed(trainer, "_error", "loss, forward")
timed(trainer, "_backward", "loss, backward")
timed(trainer._adam, "step", "Adam on the networks")
timed(trainer._grid_adam, "step", "scatter and Adam on the table")
print(json.dumps("ready"), flush=True)
for line in sys.stdin:
    n = int(line)
    spent.clear()
    wall, used = time.perf_counter(), time.process_time()
    reports = [next(steps) for _ in range(n)]
    wall, used = time.perf_counter() - wall, time.process_time() - used
    means = {"wall": 1e3 * wall / n, "processor": 1e3 * used / n}
    means["rays"] = sum(report.n_rays for report in reports) / n
    means["samples"] = sum(report.n_samples for report in reports) / n
    means["mse"] = sum(report.loss for report in reports) / n
    means |= {part: 1e3 * seconds / n for part, seconds in spent.items()}
    print(json.dumps(means), flush=True)
"""


class Training:
    """A process that trains with one version of the program."""

    def __init__(self, checkout: Path, options: argparse.Namespace) -> None:
        threads = str(options.threads)
        python = checkout / ".venv" / "bin" / "python"
        self._process = subprocess.Popen(
            [
                str(python if python.exists() else sys.executable),
                "-c",
                _WORKER,
                str(options.data.resolve()),
                str(options.begin),
                options.settings,
                str(options.downscale),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=checkout,
            env=os.environ
            | {
                "PYTHONPATH": str(checkout.resolve()),
                "OMP_NUM_THREADS": threads,
                "NUMBA_NUM_THREADS": threads,
            },
        )

    def ready(self) -> None:
        """Wait until the training has come to step `--begin`."""
        self._answer()

    def steps(self, n: int) -> dict[str, float]:
        """Train `n` steps and return their mean figures, times in milliseconds."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{n}\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


def measure(options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Return the medians of each version's figures."""
    here = Path(__file__).parents[2]
    checkouts = {"this version": here} | {str(path): path for path in options.against}
    trainings = {name: Training(checkout, options) for name, checkout in checkouts.items()}
    try:
        for training in trainings.values():
            training.ready()
        turns: dict[str, list[dict[str, float]]] = {name: [] for name in trainings}
        for _ in range(options.turns):
            for name, training in trainings.items():
                turns[name].append(training.steps(options.steps))
    finally:
        for training in trainings.values():
            training.close()
    found = {
        name: {key: float(np.median([turn[key] for turn in each])) for key in each[0]}
        for name, each in turns.items()
    }
    for name in trainings:
        for kind in ("wall", "processor"):
            by_turn = [
                here[kind] / here["rays"] / (there[kind] / there["rays"])
                for here, there in zip(turns[name], turns["this version"], strict=True)
            ]
            found[name][f"{kind} time a ray, times this version's"] = float(np.median(by_turn))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--against", type=Path, nargs="*", default=[], help="checkouts of other versions")
    parser.add_argument("--begin", type=int, default=1000, help="step at which the timing begins")
    parser.add_argument("--turns", type=int, default=20)
    parser.add_argument("--steps", type=int, default=64, help="steps of a turn")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--downscale", type=int, default=1, help="factor that pictures are reduced by")
    parser.add_argument("--settings", default="{}", help="training settings, as JSON")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    found = measure(options)
    print(f"| | {' | '.join(found)} |\n|---|{'---|' * len(found)}")
    for key in found["this version"]:
        print(f"| {key} | {' | '.join(f'{each.get(key, 0):.4g}' for each in found.values())} |")
    if options.json is not None:
        options.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
