"""Loss by the number of feature lookups for each ray, view by view.

    python -m tests.benchmarks.bench_lookups every/ k5/ --data lego_400 --views 50 --json found.json

Plays each asset on the same test views with each number of lookups, where 0 stands for every sample, and
compares the pictures, in 8 bits, with the photographs. Prints the mean PSNR; the file holds that of every
view.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from player.asset.asset import Asset
from player.render import Renderer
from tests.benchmarks.bench_specks import test_views
from vfr_bake.data.scene import evenly
from vfr_bake.training.scores.metrics import psnr


def view_scores(folder: Path, data: Path, n_views: int, samples: list[int]) -> dict[str, list[float]]:
    """Return the PSNR in dB of every view, by the number of lookups; views are spread evenly."""
    asset = Asset.open(folder)
    cameras, photographs = test_views(asset, data)
    chosen = evenly(len(cameras), n_views)
    with Renderer(asset) as renderer:
        return {
            str(k): [
                float(psnr(renderer.render(cameras[i], k).to_uint8() / 255, photographs[i])) for i in chosen
            ]
            for k in samples
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("assets", type=Path, nargs="+")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--views", type=int, default=50)
    parser.add_argument("--samples", type=int, nargs="+", default=[1, 2, 3, 4, 5, 8, 12, 16, 32, 0])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found = {}
    for folder in arguments.assets:
        scores = view_scores(folder, arguments.data, arguments.views, arguments.samples)
        found[str(folder)] = scores
        told = ", ".join(f"{k or 'every'}: {np.mean(some):.2f}" for k, some in scores.items())
        print(f"{folder}, dB by lookups: {told}", flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
