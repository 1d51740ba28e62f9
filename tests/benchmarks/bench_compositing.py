"""Compare volume feature rendering with standard volume rendering: same data, the paper's head (6x256), same
batch, the same minutes, in one run.

    python tests/benchmarks/bench_compositing.py ../shared/data/lego_400 --minutes 4

The two trainings take turns of a few seconds, so that both run on the same machine under the same load. Both
learn from all rays and samples, and sample each batch before its step. A training on features usually skips
those with next to no gradient, and samples ahead on a second thread; here, the ratio is to be the effect of
compositing alone.
Prints steps per second and PSNR on held-out views.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vfr_bake.config import Compositing, FieldOptions, TrainConfig
from vfr_bake.data import load_scene
from vfr_bake.data.scene import Scene, evenly
from vfr_bake.evaluation import render_views
from vfr_bake.training.model_file import trained_model
from vfr_bake.training.trainer import Trainer

KINDS: tuple[Compositing, ...] = ("features", "colour")


class Turns:
    """A training that runs for some seconds at a time."""

    def __init__(self, scene: Scene, compositing: Compositing, options: argparse.Namespace) -> None:
        field = FieldOptions(compositing=compositing, head_width=256)
        given = {name: getattr(options, name) for name in ("batch_samples", "step_cells")}
        settings = {name: value for name, value in given.items() if value is not None}
        self.trainer = Trainer(scene, TrainConfig(minutes=options.minutes, field=field, **settings))
        self.trainer._skips = lambda pilot: False
        self.seconds, self.done = 0.0, False

    def advance(self, seconds: float) -> None:
        # A fresh iterator continues at the seconds trained so far, so that waiting does not count.
        reports: Iterator = self.trainer.run()
        until = self.trainer.seconds + seconds
        for report in reports:
            if report.seconds >= until:
                break
        else:
            self.done = True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--batch-samples", type=int, help="objects: samples in a batch")
    parser.add_argument("--step-cells", type=float, help="objects: length of a march step, in cells")
    parser.add_argument("--views", type=int, default=25)
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    scene = load_scene(options.data, downscale=options.downscale)
    runs = {kind: Turns(scene, kind, options) for kind in KINDS}
    while not all(run.done for run in runs.values()):
        for run in runs.values():
            if not run.done:
                run.advance(5.0)
    print("| compositing | steps | steps/s | PSNR, dB |")
    print("|---|---|---|---|")
    found = {}
    for kind, run in runs.items():
        trainer = run.trainer
        model, n_views = trained_model(trainer, scene, {}), len(scene.test.cameras)
        chosen = evenly(n_views, options.views)
        scores = [view.score() for view in render_views(model, scene.test, chosen)]
        rate = trainer.next_step / trainer.seconds
        psnr = float(np.mean([score.psnr for score in scores]))
        found[kind] = {"steps": trainer.next_step, "steps_a_second": rate, "psnr": psnr}
        found[kind] |= {"minutes": options.minutes, "n_views": len(scores)}
        print(f"| {kind} | {trainer.next_step} | {rate:.2f} | {psnr:.2f} |", flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
