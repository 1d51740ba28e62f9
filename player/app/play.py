"""`vfr-play` with views: cameras to files, one frame after another or on many machines."""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from player.app.frame_files import Target, encode_frame, frame_key, unfinished
from player.asset.asset import Asset
from player.cameras.camera import Camera, orbit
from player.cameras.transforms import read_cameras
from player.cameras.views import frame_rate, read_views
from player.errors import ConfigError
from player.files.files import write_bytes
from player.progress import Bar, duration
from player.render import FRAME_BYTES, Background, March, Renderer, check_size, import_ahead

FPS = 30.0
LARGE_BYTES = 1e9
"""From here on the memory of a picture is said before it is rendered."""


@dataclass(frozen=True)
class PlaySettings:
    """What pictures depend on besides asset and camera, and what renders them."""

    samples: int | None = None
    """Feature fetches a ray; the asset's own if None, every sample if 0."""
    background: Background | None = None
    """Colour 0..1 or "transparent"; the asset's own if None."""
    threads: int | None = None
    march: March = "auto"
    max_memory: float | None = None
    """Gigabytes that the asset may take on a worker; a share of its machine's if None."""


@dataclass(frozen=True)
class Job:
    """One frame to render: the camera, what its picture will carry, and the format, ".png" or ".webp"."""

    camera: Camera
    key: str
    suffix: str


@dataclass(frozen=True)
class Done:
    """One rendered frame: which of the jobs, its file's bytes, and the time that rendering took."""

    index: int
    data: bytes
    milliseconds: float
    march: str
    threads: int


def play(arguments: argparse.Namespace, say: Callable[[str], object]) -> tuple[dict[str, Any], str]:
    """Render what the command line asks for; returns figures and a sentence for people.

    `say` is called with what a person should know before the work begins.
    """
    target = Target.of(arguments.output, arguments.format)
    target.check(arguments.force, arguments.resume)
    import_ahead(scipy=False)
    asset = Asset.open(arguments.asset, max_memory=arguments.max_memory)
    every = _views(asset, arguments)
    cameras, paths = every[arguments.frames], target.paths(every, arguments.frames)
    if not cameras:
        raise ConfigError(f"--frames: expected at least one of the {len(every)} views, got none")
    _check_sizes(cameras, target, say)
    fps = _fps(arguments) if target.is_video else FPS
    settings = PlaySettings(
        arguments.samples, arguments.background, arguments.threads, arguments.march, arguments.max_memory
    )
    keys = [frame_key(asset, camera, settings.samples, settings.background) for camera in cameras]
    missing = unfinished(paths, keys, cameras) if arguments.resume else list(range(len(cameras)))
    jobs = [Job(cameras[index], keys[index], target.suffix) for index in missing]
    most = asset.most_samples
    if settings.samples is not None and settings.samples > most:
        say(f"--samples {settings.samples}: a ray has {most} samples at most, and every one is taken")
    if jobs and not arguments.dask and settings.march != "numpy":
        from player.proof import prove

        prove(say)
    begin = time.perf_counter()
    done: list[Done] = []
    frames = _on_cluster if arguments.dask else _here
    with Bar(len(jobs)) as bar:
        for frame in frames(asset, jobs, settings, arguments.dask):
            write_bytes(paths[missing[frame.index]], frame.data)
            done.append(frame)
            bar.advance(frame.milliseconds)
    target.finish(paths, fps)
    figures = _figures(asset, cameras, done, settings)
    return figures, _sentence(target, figures, len(cameras), time.perf_counter() - begin)


def render_job(renderer: Renderer, job: Job, index: int, settings: PlaySettings) -> Done:
    """One frame, as the bytes of its file."""
    start = time.perf_counter()
    frame = renderer.render(job.camera, settings.samples, settings.background)
    milliseconds = (time.perf_counter() - start) * 1000
    data = encode_frame(job.suffix, frame.to_uint8(), job.key)
    return Done(index, data, milliseconds, renderer.march, renderer.n_threads)


def _here(asset: Asset, jobs: list[Job], settings: PlaySettings, _: str | None) -> Iterator[Done]:
    if not jobs:
        return
    with Renderer(asset, settings.threads, settings.march) as renderer:
        # compiles, or reads what was compiled before
        renderer.render(jobs[0].camera.resized(64, 64), settings.samples, settings.background)
        for index, job in enumerate(jobs):
            yield render_job(renderer, job, index, settings)


def _on_cluster(asset: Asset, jobs: list[Job], settings: PlaySettings, address: str) -> Iterator[Done]:
    from player.app.cluster import render_on_cluster

    return render_on_cluster(address, asset.folder, jobs, settings)


def _views(asset: Asset, arguments: argparse.Namespace) -> list[Camera]:
    width, height = asset.manifest.view_size
    if arguments.cameras is not None:
        cameras = read_views(arguments.cameras, (width, height))
    else:
        cameras = read_cameras(asset.path("cameras.json"), (width, height))
    if arguments.orbit is not None:
        return orbit(cameras, arguments.orbit, arguments.size or (width, height))
    if arguments.view is not None:
        n = len(cameras)
        if not -n <= arguments.view < n:
            raise ConfigError(f"--view: expected 0 to {n - 1}, got {arguments.view}")
        cameras = [cameras[arguments.view]]
    return cameras if arguments.size is None else [camera.resized(*arguments.size) for camera in cameras]


def _check_sizes(cameras: list[Camera], target: Target, say: Callable[[str], object]) -> None:
    for camera in cameras:
        check_size(camera.width, camera.height)
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if target.is_video and len(sizes) > 1:
        raise ConfigError(f"{target.path}: expected views of one size for a video, got {sizes}: add --size")
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    n_bytes = width * height * FRAME_BYTES
    if n_bytes >= LARGE_BYTES:
        say(f"a picture of {width}x{height} takes {n_bytes / 1e9:.1f} GB of memory")


def _fps(arguments: argparse.Namespace) -> float:
    if arguments.fps is not None:
        return arguments.fps
    found = None if arguments.cameras is None else frame_rate(arguments.cameras)
    return FPS if found is None else found


def _figures(asset: Asset, cameras: list[Camera], done: list[Done], settings: PlaySettings) -> dict[str, Any]:
    times = sorted(frame.milliseconds for frame in done)
    return {
        "ms_median": statistics.median(times) if times else None,
        "ms_p95": times[math.ceil(0.95 * len(times)) - 1] if times else None,
        "frames": len(times),
        "width": cameras[0].width,
        "height": cameras[0].height,
        "threads": done[0].threads if done else None,
        "march": done[0].march if done else None,
        "peak_rss_mb": peak_rss_mb(),
        "samples": asset.manifest.n_samples if settings.samples is None else settings.samples,
    }


def _sentence(target: Target, figures: dict[str, Any], n_views: int, seconds: float) -> str:
    n, ms = figures["frames"], figures["ms_median"]
    kept = f" ({n_views - n} were there already)" if n < n_views else ""
    what = f"{n} picture{'s' * (n != 1)}{kept} of {figures['width']}x{figures['height']}"
    if ms is None:
        return f"{target.path}: {what}, nothing left to render"
    return (
        f"{target.path}: {what} in {duration(seconds) if seconds >= 60 else f'{seconds:.1f} s'}; "
        f"rendering {ms:.0f} ms a frame "
        f"({1000 / ms:.1f} frames/s, {figures['march']}, {figures['threads']} threads)"
    )


def kept(output: Path, form: str | None) -> str:
    """Where an interrupted run left its finished frames."""
    folder = Target.of(output, form).folder
    return f"the frames that were finished are kept in {folder}; --resume goes on"


def peak_rss_mb() -> float | None:
    """Most memory that this process has had, in MB; None where the system does not tell."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
