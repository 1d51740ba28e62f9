"""Frame times of both marches with every quality, taken in turns, and the loss of each quality.

    python -m tests.benchmarks.bench_qualities out/ --data lego_400 --size 800x800 --json found.json

There is a process for each march and quality. They take turns frame by frame, so that other work of the
machine affects all of them alike. The views are a walk through some training views and a slow turn around the
scene. Times are medians, with the uncertainty of `vfr_bake.bench.timing`. Losses are relative to exact
pictures on test views of DATA: the mean and the worst view, in dB of PSNR compared with the photographs.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from player.app.option_types import positive, size
from player.asset.asset import Asset
from player.threads import default_threads
from tests.benchmarks.against import QUALITIES, Player, views
from tests.benchmarks.bench_specks import test_views
from vfr_bake.bench.timing import notch
from vfr_bake.training.scores.metrics import psnr

HERE = Path(__file__).parents[2]


def frame_times(
    folder: Path, frame_size: tuple[int, int], n_frames: dict[str, int], threads: int, scratch: Path
) -> list[dict[str, Any]]:
    """Return a row for each march, of which so many frames are timed, and each quality."""
    rows = []
    with ExitStack() as stack:
        players = {}
        for march in n_frames:
            for quality in QUALITIES:
                player = Player(HERE, folder, threads, march, quality, scratch / f"{march}_{quality}.npy")
                stack.callback(player.close)
                players[march, quality] = player
        cameras = views(Asset.open(folder), frame_size, max(n_frames.values()))
        for player in players.values():
            player.frame(cameras[0])
        taken: dict[tuple[str, str], list[list[float]]] = {key: [] for key in players}
        for turn, camera in enumerate(cameras):
            for key, player in players.items():
                # The slow march renders fewer frames, spread over the same views.
                every = max(len(cameras) // n_frames[key[0]], 1)
                if turn % every == 0:
                    taken[key].append(player.frame(camera)[0])
    for march in n_frames:
        walls = {quality: 1000 * np.array(taken[march, quality])[:, 0] for quality in QUALITIES}
        shared = np.mean(list(walls.values()), axis=0)
        for quality, wall in walls.items():
            figures = np.array(taken[march, quality])
            row = {"march": march, "quality": quality, "frames": len(wall), "ms": float(np.median(wall))}
            row["uncertainty"] = notch(wall, list(shared))
            row["processor_ms"] = 1000 * float(np.median(figures[:, 1]))
            row["times_as_fast"] = float(np.median(walls["exact"] / wall))
            rows.append(row | {"peak_mb": float(figures[:, 2].max())})
    return rows


def losses(
    folder: Path, data: Path, n_views: int, threads: int, scratch: Path
) -> dict[str, dict[str, float]]:
    """Return the loss of each quality but exact, compared with photographs, and exact's PSNR."""
    asset = Asset.open(folder)
    cameras, photographs = test_views(asset, data)
    chosen = np.linspace(0, len(cameras) - 1, min(n_views, len(cameras))).round().astype(int)
    scores = {}
    for quality in QUALITIES:
        player = Player(HERE, folder, threads, "numba", quality, scratch / f"{quality}.npy")
        try:
            scores[quality] = np.array([psnr(player.frame(cameras[i])[1], photographs[i]) for i in chosen])
        finally:
            player.close()
    return {
        quality: {
            "psnr": float(some.mean()),
            "loss_db": float((scores["exact"] - some).mean()),
            "worst_db": float((scores["exact"] - some).max()),
        }
        for quality, some in scores.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--views", type=positive, default=8)
    parser.add_argument("--size", type=size, default=(800, 800))
    parser.add_argument("--frames", type=positive, default=20, help="frames with numba")
    parser.add_argument("--numpy-frames", type=positive, default=5, help="frames without it")
    parser.add_argument("--threads", type=positive, default=default_threads())
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    n_frames = {"numba": arguments.frames, "numpy": arguments.numpy_frames}
    with tempfile.TemporaryDirectory(prefix="vfr-bench-") as scratch:
        rows = frame_times(arguments.asset, arguments.size, n_frames, arguments.threads, Path(scratch))
        lost = losses(arguments.asset, arguments.data, arguments.views, arguments.threads, Path(scratch))
    for row in rows:
        some = lost[row["quality"]]
        print(
            f"{row['march']:6} {row['quality']:6} {row['ms']:7.1f} ± {row['uncertainty']:.1f} ms a frame, "
            f"{row['times_as_fast']:.2f} times as fast as exact, "
            f"{some['loss_db']:.3f} dB lost (worst view {some['worst_db']:.3f})"
        )
    if arguments.json is not None:
        found = {"size": list(arguments.size), "threads": arguments.threads, "rows": rows, "losses": lost}
        arguments.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
