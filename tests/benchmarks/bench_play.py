"""Milliseconds a frame of an asset: march with lookups, head, and the rest; numpy against numba.

    python tests/benchmarks/bench_play.py out/ --cameras transforms_test.json --size 800x800

March and head are timed inside their tasks and divided by the number of threads: what they take of a frame
when all threads are busy. Medians over the frames. The two marches must give the same picture within one
level of eight bits.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from player.asset import Asset
from player.cameras import orbit
from player.options import _positive, _size
from player.play import peak_rss_mb
from player.render import Renderer
from player.transforms import read_cameras
from vfr_bake.bench.process import Clock


def measure(asset: Asset, cameras: list, name: Any, n_threads: int | None, k: int | None) -> np.ndarray:
    rows, n_hits, n_samples = [], [], []
    with Renderer(asset, n_threads, name) as renderer:
        march, head = Clock(renderer._module.march), Clock(renderer._head)
        renderer._module, renderer._head = SimpleNamespace(march=march), head  # type: ignore[assignment]
        renderer.render(cameras[0].resized(64, 64), k)
        for camera in cameras:
            march.seconds = head.seconds = 0.0
            start = time.perf_counter()
            frame = renderer.render(camera, k)
            total = time.perf_counter() - start
            parts = march.seconds / renderer.n_threads, head.seconds / renderer.n_threads
            rows.append([1000 * t for t in (total, *parts, total - sum(parts))])
            hit = frame.opacity > 1 / 1024
            n_hits.append(hit.mean())
            n_samples.append(frame.n_samples.sum() / max(hit.sum(), 1))
        total, in_march, in_head, rest = (statistics.median(column) for column in zip(*rows, strict=True))
        print(
            f"{renderer.march:6} {renderer.n_threads} threads: {total:7.1f} ms a frame = march and lookups "
            f"{in_march:.1f} + head {in_head:.1f} + rest {rest:.1f}; {100 * np.mean(n_hits):.0f} % of the "
            f"pixels hit, {np.mean(n_samples):.1f} density samples each"
        )
    return frame.to_uint8()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("--cameras", type=Path, help="transforms.json; else an orbit")
    parser.add_argument("--size", type=_size, default=(800, 800))
    parser.add_argument("--frames", type=_positive, default=8)
    parser.add_argument("--threads", type=_positive)
    parser.add_argument("--samples", type=int)
    arguments = parser.parse_args()
    start = time.perf_counter()
    asset = Asset.open(arguments.asset)
    size = asset.manifest.view_size[0], asset.manifest.view_size[1]
    asset.grid  # noqa: B018
    print(f"opened in {1000 * (time.perf_counter() - start):.0f} ms: {len(asset.arrays.density):,} vertices")
    if arguments.cameras:
        cameras = read_cameras(arguments.cameras, size)[: arguments.frames]
        cameras = [camera.resized(*arguments.size) for camera in cameras]
    else:
        cameras = orbit(read_cameras(asset.path("cameras.json"), size), arguments.frames, arguments.size)
    pictures = [
        measure(asset, cameras, name, arguments.threads, arguments.samples) for name in ("numba", "numpy")
    ]
    worst = int(np.abs(pictures[0].astype(int) - pictures[1]).max())
    print(f"worst difference {worst} of 255; peak memory {peak_rss_mb()} MB")
    return 0 if worst <= 1 else 1


if __name__ == "__main__":
    sys.exit(main())
