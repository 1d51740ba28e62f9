"""Milliseconds a frame of an asset: march, lookups, head and the rest, beside what the machine could do.

    python -m tests.benchmarks.bench_play out/ --cameras transforms_test.json --size 800x800
    python -m tests.benchmarks.bench_play fidelity/ balanced/ fast/ --curves
    python -m tests.benchmarks.bench_play lego/ fox/ --against CHECKOUT --march numba numpy --frames 60
    python -m tests.benchmarks.bench_play out/ --against CHECKOUT ITS_ASSET

Times of the parts are processor time of all threads, divided by their number: their share of a frame if all
threads are busy. The rest of the elapsed time is waiting, for another program or for the last task. Lookups
cannot be timed by themselves: they are k / (k - 1) of the time that k fetches a ray take longer than one.
Figures are medians over the frames. The two marches must give the same picture within one level of eight
bits; a head in 8 bits sometimes rounds to another level, which moves one pixel in ten thousand by two levels
or more.

With `--against`, every quality is compared with another version of the player, which plays the same asset or
one of its own baking (`tests/benchmarks/against.py`). With `--curves`, tables of time by pixels, threads and
assets are printed, for numba alone.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: the threads are ours, as in the player

import argparse
import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from player.app.option_types import positive, size
from player.app.play import peak_rss_mb
from player.asset.asset import Asset
from player.cameras.camera import Camera, orbit
from player.cameras.transforms import read_cameras
from player.head.graph import read_head
from player.march.march import MIN_OPACITY
from player.render import Frame, Renderer
from player.threads import default_threads
from tests.benchmarks import against
from vfr_bake.bench.process import Clock

SIZES = (200, 400, 566, 800, 1131)
"""Edges of the square pictures of the curve. The number of pixels doubles, but for the first step."""


class Parts(NamedTuple):
    """Milliseconds a frame, and numbers of a frame."""

    wall: float
    march: float
    lookups: float
    head: float
    rest: float
    n_rays_hit: float
    n_density_samples: float
    n_fetches: float

    @property
    def waiting(self) -> float:
        return self.wall - self.march - self.lookups - self.head - self.rest


def measure(
    asset: Asset, cameras: list[Camera], name: Any, n_threads: int | None, k: int | None
) -> tuple[Parts, Frame]:
    """Return medians over the cameras, and the last frame."""
    k = asset.manifest.n_fetches if k is None else k
    rows = []
    with Renderer(asset, n_threads, name) as renderer:
        march, head = Clock(renderer._module.march), Clock(renderer._head)
        renderer._module, renderer._head = SimpleNamespace(march=march), head  # type: ignore[assignment]
        renderer.render(cameras[0].resized(64, 64), k)
        for camera in cameras:
            march.seconds = head.seconds = 0.0
            begin, processor = time.perf_counter(), time.process_time()
            frame = renderer.render(camera, k)
            wall, used = time.perf_counter() - begin, time.process_time() - processor
            in_march, in_head = march.seconds, head.seconds
            march.seconds = 0.0
            renderer.render(camera, 1)
            lookups = max(in_march - march.seconds, 0.0) * k / max(k - 1, 1)
            taken = frame.n_density_samples[frame.opacity > MIN_OPACITY]
            fetches = np.minimum(taken, k).sum() if k else taken.sum()
            times = (in_march - lookups, lookups, in_head, used - in_march - in_head)
            shares = [1000 * seconds / renderer.n_threads for seconds in times]
            rows.append([1000 * wall, *shares, len(taken), frame.n_density_samples.sum(), fetches])
    return Parts(*(statistics.median(column) for column in zip(*rows, strict=True))), frame


def on_threads(n_threads: int, work: Callable[[], object]) -> float:
    """Return the least processor time in seconds that a thread needs for `work` while all threads do it."""

    def timed() -> float:
        start = time.thread_time()
        work()
        return time.thread_time() - start

    with ThreadPoolExecutor(n_threads) as pool:
        rounds = [[pool.submit(timed) for _ in range(n_threads)] for _ in range(5)]
        return min(max(future.result() for future in every) for every in rounds)


def machine(n_threads: int) -> tuple[float, float]:
    """Return GFLOP/s of a float32 matrix product, and GB/s that a copy reads and writes, by all threads."""
    rng = np.random.default_rng(0)
    a, b = (rng.random((768, 768), np.float32) for _ in range(2))
    rate = n_threads * 2 * 768**3 / on_threads(n_threads, lambda: a @ b)
    source = np.ones(1 << 24, np.float32)
    target = [np.empty_like(source) for _ in range(n_threads)]
    turn = iter(range(1 << 30))
    seconds = on_threads(n_threads, lambda: np.copyto(target[next(turn) % n_threads], source))
    return rate / 1e9, n_threads * 2 * source.nbytes / seconds / 1e9


def bounds(asset: Asset, parts: Parts, rates: tuple[float, float]) -> str:
    """Return in words how long a frame's operations and bytes would take at the machine's full rates.

    A density sample reads eight codes, an entry of the table and a byte of live cells, and costs some 60
    operations. A fetch reads eight rows with their ranks. The head multiplies and adds once for each
    parameter.
    """
    flops, speed = rates
    width = asset.manifest.n_channels
    march = parts.n_density_samples * (8 + 4 + 1) / speed / 1e6, parts.n_density_samples * 60 / flops / 1e6
    lookups = (
        parts.n_fetches * 8 * (width + 2) / speed / 1e6, parts.n_fetches * 8 * (2 * width + 4) / flops / 1e6
    )  # fmt: skip
    head = (
        2
        * read_head(asset.path("head.onnx").read_bytes(), "head.onnx").n_parameters
        * parts.n_rays_hit
        / flops
        / 1e6
    )
    return (
        f"at {flops:.0f} GFLOP/s and {speed:.1f} GB/s at least: march {max(march):.1f} ms "
        f"({parts.march / max(march):.0f} times that), lookups {max(lookups):.1f} ms "
        f"({parts.lookups / max(lookups):.0f} times), head {head:.1f} ms ({parts.head / head:.1f} times)"
    )


def line(parts: Parts) -> str:
    return (
        f"{parts.wall:7.1f} ms a frame = march {parts.march:.1f} + lookups {parts.lookups:.1f} + head "
        f"{parts.head:.1f} + rest {parts.rest:.1f} + waiting {parts.waiting:.1f}"
    )


def picture_size(asset: Asset, arguments: argparse.Namespace) -> tuple[int, int]:
    """Return the size asked for; else 800x800 for objects, and the training pictures' size for captures."""
    if arguments.size is None:
        width, height = asset.manifest.view_size if asset.manifest.contracted else (800, 800)
        return width, height
    width, height = arguments.size
    return width, height


def views(asset: Asset, path: Path | None, size: tuple[int, int], n_frames: int) -> list[Camera]:
    own = asset.manifest.view_size[0], asset.manifest.view_size[1]
    if path is None:
        return orbit(read_cameras(asset.path("cameras.json"), own), n_frames, size)
    return [camera.resized(*size) for camera in read_cameras(path, own)[:n_frames]]


def compare(asset: Asset, cameras: list[Camera], n_threads: int, k: int | None) -> int:
    """Measure both marches on the same views; return the last pictures' largest difference, in levels."""
    rates = machine(n_threads)
    pictures = []
    for name in ("numba", "numpy"):
        parts, frame = measure(asset, cameras, name, n_threads, k)
        pictures.append(frame.to_uint8().astype(int))
        hit = parts.n_rays_hit / frame.opacity.size
        print(f"{name:6} {n_threads} threads: {line(parts)}")
        print(
            f"       {100 * hit:.0f} % of the pixels hit, "
            f"{parts.n_density_samples / max(parts.n_rays_hit, 1):.1f} "
            f"density samples and {parts.n_fetches / max(parts.n_rays_hit, 1):.1f} fetches each\n"
            f"       {bounds(asset, parts, rates)}"
        )
    return int(np.abs(pictures[0] - pictures[1]).max())


def curves(assets: list[Asset], arguments: argparse.Namespace, n_threads: int) -> None:
    first = assets[0]
    print("\n| pixels | ms a frame | ns a pixel |\n|---|---|---|")
    for edge in SIZES:
        cameras = views(first, arguments.cameras, (edge, edge), arguments.frames)
        parts, _ = measure(first, cameras, "numba", n_threads, arguments.samples)
        print(f"| {edge}x{edge} | {parts.wall:.0f} | {1e6 * parts.wall / edge**2:.0f} |")
    print("\n| threads | ms a frame | times threads |\n|---|---|---|")
    for n in range(1, n_threads + 1):
        cameras = views(first, arguments.cameras, picture_size(first, arguments), arguments.frames)
        parts, _ = measure(first, cameras, "numba", n, arguments.samples)
        print(f"| {n} | {parts.wall:.0f} | {parts.wall * n:.0f} |")
    print("\n| asset, MB | vertices | ms a frame | march | lookups | head | rest |")
    print("|---|---|---|---|---|---|---|")
    for asset in assets:
        cameras = views(asset, arguments.cameras, picture_size(asset, arguments), arguments.frames)
        parts, _ = measure(asset, cameras, "numba", n_threads, arguments.samples)
        size = sum(entry.bytes for entry in asset.manifest.files.values()) / 1e6
        n_vertices = asset.arrays.densities.first_rows[-1]
        print(
            f"| {asset.folder.name}, {size:.0f} | {n_vertices:,} | {parts.wall:.0f} | "
            f"{parts.march:.0f} | {parts.lookups:.0f} | {parts.head:.0f} | {parts.rest:.0f} |"
        )


def against_another(arguments: argparse.Namespace) -> int:
    """Compare each asset, with each march, with the other version's asset, or with itself played by that."""
    checkout, *own = arguments.against
    for folder, march in itertools.product(arguments.assets, arguments.march):
        size = picture_size(Asset.open(folder), arguments)
        with tempfile.TemporaryDirectory(prefix="vfr-bench-play-") as scratch:
            rows = against.compare(
                folder, (checkout, own[0] if own else folder), size, arguments.frames, arguments.threads,
                march, Path(scratch),
            )  # fmt: skip
        load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
        print(
            f"\n{folder}, {size[0]}x{size[1]}, {march}, {arguments.threads} threads, "
            f"{arguments.frames} frames{load}\n"
        )
        print("\n".join(against.lines(rows)), flush=True)
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("assets", type=Path, nargs="+")
    parser.add_argument("--cameras", type=Path, help="transforms.json; else an orbit")
    parser.add_argument("--size", type=size, help="else 800x800, or that of a capture's training pictures")
    parser.add_argument("--frames", type=positive, default=8)
    parser.add_argument("--threads", type=positive, default=default_threads())
    parser.add_argument("--samples", type=int)
    parser.add_argument("--curves", action="store_true", help="time against pixels, threads and assets")
    parser.add_argument(
        "--against", type=Path, nargs="+", metavar="PATH",
        help="a checkout of another version, and its asset if that is not the same one",
    )  # fmt: skip
    parser.add_argument(
        "--march", choices=("numba", "numpy"), nargs="+", default=["numba"], help="with --against"
    )
    arguments = parser.parse_args()
    if arguments.against:
        if len(arguments.against) > 2:
            parser.error("--against: expected a checkout and at most one asset")
        return against_another(arguments)
    start = time.perf_counter()
    assets = [Asset.open(path) for path in arguments.assets]
    assets[0].grid  # noqa: B018
    print(f"opened in {1000 * (time.perf_counter() - start):.0f} ms")
    if arguments.curves:
        curves(assets, arguments, arguments.threads)
        return 0
    worst = 0
    for asset in assets:
        cameras = views(asset, arguments.cameras, picture_size(asset, arguments), arguments.frames)
        print(f"{asset.folder}: {asset.arrays.densities.first_rows[-1]:,} vertices")
        worst = max(worst, compare(asset, cameras, arguments.threads, arguments.samples))
    print(f"worst difference {worst} of 255; peak memory {peak_rss_mb()} MB")
    return 0 if worst <= 1 else 1


if __name__ == "__main__":
    sys.exit(main())
