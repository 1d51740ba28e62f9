"""The cost of a picture of an asset's page: texture fetches, multiply-adds, and time on a processor.

    python -m tests.benchmarks.bench_page out/ --size 400 --views 3

The page is opened from a disk in Chromium, whose WebGL runs on the processor (SwiftShader). Fetches are
counted by a variant of the shader that adds one for each. The head fetches each of its weights, four a texel,
once for four pixels. Times are compared with those of `vfr-play`'s march for the same cameras, alternately:
processor time of all of the browser's processes, and elapsed time. The time to the first picture is from the
opening of the page to the first whole picture, exact and 400 pixels wide, with everything decoded and
compiled. Linux alone.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras
from player.render import Renderer
from tests.benchmarks.against import QUALITIES
from tests.player.page.render_page import RenderPage, view_of
from tests.player.page.viewer_page import chromium

OTHERS = {"MERF": (13, 896), "SMERF": (13, 960)}
"""For two other viewers, the work of their shaders (google-research, `merf/webviewer` and `smerf/webviewer`):
fetches of a visible sample, and multiply-adds of the head, which is 16 wide. Five of the fetches find index
and density, eight colours and features. Each is filtered by the hardware, which reads four or eight texels
for it. Fetches that skip empty space are not counted."""


class Cost(NamedTuple):
    """Seconds of elapsed time and of processor time."""

    wall: float
    processor: float


def family(root: int) -> list[int]:
    """Return the ids of a process and of all its descendants."""
    parents: dict[int, list[int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents.setdefault(int(fields[1]), []).append(int(path.parent.name))
    found = [root]
    for process in found:
        found += parents.get(process, [])
    return found


def processor_seconds(processes: list[int]) -> float:
    """Return the seconds of processor time that the processes have used so far."""
    total = 0.0
    for process in processes:
        try:
            fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def timed(work: Callable[[], object], seconds: Callable[[], float]) -> Cost:
    begin, before = time.perf_counter(), seconds()
    work()
    return Cost(time.perf_counter() - begin, seconds() - before)


def least(costs: list[Cost]) -> Cost:
    return Cost(min(c.wall for c in costs), min(c.processor for c in costs))


def main() -> None:
    parser = argparse.ArgumentParser(description="What a picture of an asset's page costs.")
    parser.add_argument("asset", type=Path)
    parser.add_argument("--size", type=int, default=400, help="pixels along the longer edge")
    parser.add_argument("--views", type=int, default=3, help="cameras of the asset, evenly spread")
    parser.add_argument("--rounds", type=int, default=2, help="pictures of each, of which the fastest counts")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    asset = Asset.open(arguments.asset)
    every = read_cameras(asset.path("cameras.json"))
    chosen = [every[i] for i in np.linspace(0, len(every) - 1, arguments.views).astype(int)]
    shares = [arguments.size / max(camera.width, camera.height) for camera in chosen]
    cameras = [camera.scaled(share) for camera, share in zip(chosen, shares, strict=True)]
    with chromium() as browser, tempfile.TemporaryDirectory() as folder:
        page = RenderPage(browser, asset, Path(folder) / "scene.html")
        times = page.page.evaluate("() => times")
        begin = time.perf_counter()
        page.picture(cameras[0], quality="exact")
        first = times["uploaded"] / 1000 + time.perf_counter() - begin
        print(f"{arguments.asset}: first picture after {first:.1f} s, of which")
        print(
            "  milliseconds after the page was opened: "
            + ", ".join(f"{n} {ms:.0f}" for n, ms in times.items())
        )
        found = {"n_bytes": (Path(folder) / "scene.html").stat().st_size, "first_picture_s": first}
        found |= {"size": arguments.size, "counts": report_counts(asset, page, cameras)}
        found["times"] = report_times(asset, page, cameras, arguments.rounds)
        page.close()
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found), encoding="utf-8")


def report_counts(asset: Asset, page: RenderPage, cameras: list[Camera]) -> dict[str, Any]:
    """Print and return what the page holds, and its work for a pixel."""
    info = page.page.evaluate("() => vfr.info")
    share = 0.0
    print(f"  {info['gpuBytes'] / 1e6:.0f} MB of graphics memory, {info['renderer']}")
    with Renderer(asset, 2) as player:
        n_samples = np.mean([player.render(camera).n_density_samples.mean() for camera in cameras])
    told: dict[str, Any] = {"gpu_bytes": info["gpuBytes"], "renderer": info["renderer"]}
    print("  quality   fetches a pixel   a pixel that is hit   pixels hit   multiply-adds a pixel")
    for quality in QUALITIES:
        rows = []
        for camera in cameras:
            found = page.page.evaluate("view => counts(view)", view_of(camera) | {"quality": quality})
            fetches = np.frombuffer(base64.b64decode(found["fetches"]), np.uint32)
            hit = found["nHits"] / len(fetches)
            weights = hit * info["multiplyAdds"] / 16  # four weights a texel, for four pixels
            rows.append((fetches.mean(), fetches.mean() / max(hit, 1e-9), hit, weights))
        marched, per_hit, hit, weights = np.mean(rows, axis=0)
        print(
            f"  {quality:8} {marched:9.1f} + {weights:.0f} {per_hit:17.1f} {100 * hit:15.1f} % "
            f"{hit * info['multiplyAdds']:18.0f}"
        )
        told[quality] = {"fetches": marched, "weights": weights, "multiply_adds": hit * info["multiplyAdds"]}
        share = hit
    for name, (fetches, multiply_adds) in OTHERS.items():
        told[name] = {"fetches": n_samples * fetches, "multiply_adds": share * multiply_adds}
        print(
            f"  {name:8} {n_samples * fetches:9.1f}       {n_samples * fetches / share:17.1f} "
            f"{'':17} {share * multiply_adds:18.0f}   (filtered, on the same {n_samples:.1f} samples a pixel)"
        )
    return told


def report_times(
    asset: Asset, page: RenderPage, cameras: list[Camera], n_rounds: int
) -> dict[str, dict[str, float]]:
    """Print and return the milliseconds of a picture in each quality, beside those of `vfr-play`."""
    processes = family(os.getpid())
    processes.remove(os.getpid())

    def browser_seconds() -> float:
        return processor_seconds(processes)

    print("  milliseconds a picture, wall and processor: the page, vfr-play, times as much")
    found = {}
    with Renderer(asset, 2) as player:
        player.render(cameras[0])
        for quality in QUALITIES:
            page.picture(cameras[0], quality=quality)
            rows = []
            for camera in cameras:
                pairs = [
                    (
                        timed(partial(page.picture, camera, quality=quality), browser_seconds),
                        timed(partial(player.render, camera), time.process_time),
                    )
                    for _ in range(n_rounds)
                ]
                rows.append([*least([a for a, _ in pairs]), *least([b for _, b in pairs])])
            wall, used, player_wall, player_used = (
                1000 * statistics.mean(c) for c in zip(*rows, strict=True)
            )
            found[quality] = {"wall": wall, "processor": used, "player_wall": player_wall}
            found[quality]["player_processor"] = player_used
            print(
                f"  {quality:8} {wall:7.0f} {used:7.0f}   {player.march} {player_wall:6.0f}"
                f" {player_used:6.0f}   {wall / player_wall:5.1f} {used / player_used:5.1f}"
            )
    return found


if __name__ == "__main__":
    main()
