"""Rows D to I of the paper's ablation (table 4), at a size that two CPU cores can do.

    python tests/benchmarks/bench_ablation.py ../shared/data/lego_400 --downscale 2 --output lego.json

Every row trains on the same number of samples, and evaluates its head layer by layer in float32. The faster
code of a usual training does not fit the heads of D, E and H, so with it rows could not be compared. Rows
take turns, so that a machine that slows down slows all of them. A run that is already in the output file is
not done again. Prints a table of means and standard deviations over the seeds.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from vfr_bake.config import FieldOptions, TrainConfig
from vfr_bake.data import load_scene
from vfr_bake.data.scene import Scene, evenly
from vfr_bake.evaluation import render_views
from vfr_bake.training.model_file import trained_model
from vfr_bake.training.trainer import Trainer

ROWS: dict[str, dict[str, Any]] = {
    "D": dict(activation="relu", head_width=64, n_directional_layers=2, view_encoding="sh"),
    "E": dict(activation="gelu", head_width=64, n_directional_layers=2, view_encoding="sh"),
    "F": dict(activation="gelu", head_width=64, n_directional_layers=4, view_encoding="sh-features"),
    "G": dict(activation="gelu", head_width=128, n_directional_layers=4, view_encoding="sh-features"),
    "H": dict(activation="gelu", head_width=256, n_directional_layers=4, view_encoding="sh"),
    "I": dict(activation="gelu", head_width=256, n_directional_layers=4, view_encoding="sh-features"),
}


def train(scene: Scene, row: str, seed: int, options: argparse.Namespace) -> dict[str, float]:
    """Return the PSNR and SSIM of one run on held-out views, and its seconds."""
    config = TrainConfig(
        steps=options.steps, minutes=1e6, seed=seed, batch_samples=options.batch_samples,
        batch_rays=options.batch_rays, field=FieldOptions(**ROWS[row]),
    )  # fmt: skip
    trainer = Trainer(scene, config)
    trainer.field.head._is_fused = False
    begin = time.monotonic()
    for report in trainer.run():
        if sys.stderr.isatty():
            print(f"\r{row} seed {seed} {report.progress:.0%}", end="", file=sys.stderr)
    seconds = time.monotonic() - begin
    model, n_views = trained_model(trainer, scene, {}), len(scene.test.cameras)
    chosen = evenly(n_views, options.views)
    scores = [view.score() for view in render_views(model, scene.test, chosen)]
    return {
        "psnr": float(np.mean([score.psnr for score in scores])),
        "ssim": float(np.mean([score.ssim for score in scores if score.ssim is not None])),
        "seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--output", type=Path, required=True, help="JSON with every run")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--batch-samples", type=int, default=4096)
    parser.add_argument("--batch-rays", type=int, default=256)
    parser.add_argument("--views", type=int, default=12)
    options = parser.parse_args()
    runs = json.loads(options.output.read_text()) if options.output.exists() else {}
    scene = load_scene(options.data, downscale=options.downscale)
    for seed in range(options.seeds):
        for row in ROWS:
            if f"{row}{seed}" not in runs:
                runs[f"{row}{seed}"] = train(scene, row, seed, options)
                print(f"{row}{seed}", runs[f"{row}{seed}"], file=sys.stderr, flush=True)
                options.output.write_text(json.dumps(runs, indent=1))
    print("| row | activation | head | view encoding | PSNR, dB | SSIM | time, s |")
    print("|---|---|---|---|---|---|---|")
    for row, field in ROWS.items():
        found = {
            name: np.array([runs[f"{row}{seed}"][name] for seed in range(options.seeds)])
            for name in ("psnr", "ssim", "seconds")
        }
        print(
            f"| {row} | {field['activation']} | {2 + field['n_directional_layers']}x{field['head_width']} "
            f"| {field['view_encoding']} | {found['psnr'].mean():.2f} ± {found['psnr'].std(ddof=1):.2f} "
            f"| {found['ssim'].mean():.4f} ± {found['ssim'].std(ddof=1):.4f} "
            f"| {found['seconds'].mean():.0f} |"
        )


if __name__ == "__main__":
    main()
