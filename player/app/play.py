"""Rendering of views into picture files or a video, one frame after another or on many machines."""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from player.app.frame_files import Target, frame_key, unfinished, video_key
from player.app.jobs import Done, Job, render_job
from player.app.options import VIDEO, PlaySettings
from player.app.video import MOST_VIDEO_SIDE
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.errors import ConfigError
from player.files.files import write_bytes
from player.files.images import MOST_WEBP_SIDE
from player.render import FRAME_BYTES, MAX_PIXELS, Renderer, check_size, choose_march, fetches_used

LARGE_BYTES = 1e9
"""A line warns before a picture is rendered, or a video, that takes this many bytes of memory or more."""
MEMORY_BYTES = {".png": FRAME_BYTES, ".webp": 50, VIDEO: 240}
"""Most memory of a picture or a video while it is made, in bytes per pixel, by its suffix. WebP's encoder
takes 38 to 44 besides the 8-bit picture, which is all that is left of the frame by then. That of H.264
compares dozens of pictures: it takes 190 to 225 for a film of 60 or more."""
MOST_SIDE = {".png": MAX_PIXELS, ".webp": MOST_WEBP_SIDE, VIDEO: MOST_VIDEO_SIDE}
"""Most pixels along a side of a picture or a video, by its suffix. PNG allows more than are rendered."""

Say = Callable[[str], object]
Advance = Callable[[int, int, float], object]


class Played(NamedTuple):
    """The result of `play`."""

    figures: dict[str, Any]
    """The figures that `vfr-play --json` writes: `ms_median` and `ms_p95` of a frame, the number of `frames`
    that were rendered, their `width` and `height`, `threads`, `march`, `peak_rss_mb`, `n_fetches` and
    `quality`."""
    n_kept: int
    """Frames that existed already."""
    seconds: float
    """Time that rendering and writing took."""


def play(
    asset: Asset,
    cameras: Sequence[Camera],
    settings: PlaySettings,
    say: Say = lambda text: None,
    advance: Advance = lambda n_done, n_frames, milliseconds: None,
) -> Played:
    """Render an asset from `cameras` into picture files or a video.

    The file of a frame appears when it is complete. After a KeyboardInterrupt, the finished files remain, and
    the setting `resume` goes on with the others. With `force`, the frames that are to be replaced are removed
    once the first new one is rendered, so that frames of two runs are never mixed.

    Args:
        asset: an open asset.
        cameras: in the WORLD frame; pictures are named after them.
        settings: where pictures go, and how they are rendered.
        say: called with each line that a person should know before long work begins.
        advance: called after every frame, with the number of frames done, the number of frames to do and the
            milliseconds that this one took.

    Raises:
        ConfigError: `cameras` is one camera or an empty list, none of them is chosen, a picture is too
            large, or too large for its format, sizes differ in a video, or a resumed run finds pictures or a
            video that show something else.
        MissingExtraError: a video without PyAV, a cluster without dask.distributed, or numba where it is
            asked for and does not run.
        OutputError: a file exists already, or cannot be written.
        VfrError: the cluster fails.

    >>> from pathlib import Path
    >>> import player
    >>> from player.cameras.camera import orbit
    >>> from player.cameras.views import asset_cameras
    >>> asset = player.Asset.open("out/")
    >>> turn = orbit(asset_cameras(asset), 3, size=(32, 24))
    >>> played = player.play(asset, turn, player.PlaySettings(Path("turn"), march="numpy"))
    >>> played.figures["frames"], sorted(path.name for path in Path("turn").iterdir())
    (3, ['orbit_000.png', 'orbit_001.png', 'orbit_002.png'])
    """
    if isinstance(cameras, Camera):
        raise ConfigError("cameras: expected a list of cameras, got one: write [camera]")
    if not len(cameras):
        raise ConfigError("cameras: expected at least one, got none")
    target = Target.of(settings)
    target.check(settings)
    part = settings.frames or slice(None)
    paths = target.paths(cameras, part)
    chosen = cameras[part]
    if not chosen:
        raise ConfigError(f"--frames: expected at least one of the {len(cameras)} views, got none")
    _check_sizes(chosen, target, say)
    if not settings.dask and settings.march != "numpy":
        from player.proof import prove

        prove(say)
    if settings.march == "auto":  # for keys and for the workers of a cluster, which might choose another
        settings = replace(settings, march=choose_march("auto")[0])
    keys = [frame_key(asset, camera, settings) for camera in chosen]
    film = video_key(keys, settings.fps)
    if is_complete := settings.resume and target.is_complete(paths, film):
        missing = []
    else:
        missing = unfinished(paths, keys, chosen) if settings.resume else range(len(chosen))
    jobs = [
        Job(
            n,
            chosen[index],
            settings.samples,
            settings.background,
            settings.quality,
            keys[index],
            target.suffix,
        )
        for n, index in enumerate(missing)
    ]
    if settings.samples is not None and settings.samples > asset.most_samples:
        say(
            f"--samples {settings.samples}: a ray has {asset.most_samples} samples at most, "
            "and every one is taken"
        )
    begin = time.perf_counter()
    done: list[Done] = []
    for frame in _rendered(asset, jobs, settings):
        if settings.force and not done:
            for path in paths:
                with suppress(OSError):  # a folder, for example: writing there raises it
                    path.unlink()
        write_bytes(paths[missing[frame.index]], frame.data)
        done.append(replace(frame, data=b""))  # the files of a long film would fill the memory
        advance(len(done), len(jobs), frame.milliseconds)
    if not is_complete:
        target.finish(paths, settings.fps, film)
    figures = _figures(asset, chosen[0], done, settings)
    return Played(figures, len(chosen) - len(done), time.perf_counter() - begin)


def _rendered(asset: Asset, jobs: Sequence[Job], settings: PlaySettings) -> Iterator[Done]:
    """Render every job once; on a cluster in the order in which they are finished."""
    if settings.dask:
        from player.app.cluster import render_on_cluster

        yield from render_on_cluster(settings.dask, asset, jobs, settings)
    elif jobs:
        with Renderer(asset, settings.threads, settings.march) as renderer:
            # a first frame, which compiles, or loads what was compiled before
            small = jobs[0].camera.resized(64, 64)
            renderer.render(small, settings.samples, settings.background, quality=settings.quality)
            for job in jobs:
                yield render_job(renderer, job)


def _check_sizes(cameras: Sequence[Camera], target: Target, say: Say) -> None:
    for camera in cameras:
        check_size(camera.width, camera.height)
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if target.is_video and len(sizes) > 1:
        raise ConfigError(f"{target.path}: expected views of one size for a video, got {sizes}: add --size")
    what, suffix = ("video", VIDEO) if target.is_video else ("picture", target.suffix)
    width, height = max(sizes, key=max)
    if max(width, height) > MOST_SIDE[suffix]:
        raise ConfigError(
            f"{target.path}: expected at most {MOST_SIDE[suffix]} pixels a side for {suffix}, "
            f"got {width}x{height}: write PNG pictures"
        )
    width, height = max(sizes, key=math.prod)
    n_bytes = width * height * MEMORY_BYTES[suffix]
    if n_bytes >= LARGE_BYTES:
        say(f"a {what} of {width}x{height} takes {n_bytes / 1e9:.1f} GB of memory")


def _figures(asset: Asset, camera: Camera, done: list[Done], settings: PlaySettings) -> dict[str, Any]:
    times = sorted(frame.milliseconds for frame in done)
    return {
        "ms_median": statistics.median(times) if times else None,
        "ms_p95": times[math.ceil(0.95 * len(times)) - 1] if times else None,
        "frames": len(times),
        "width": camera.width,
        "height": camera.height,
        "threads": done[0].threads if done else None,
        "march": done[0].march if done else None,
        "peak_rss_mb": peak_rss_mb(),
        "n_fetches": fetches_used(asset, settings.samples, settings.quality),
        "quality": settings.quality,
    }


def peak_rss_mb() -> float | None:
    """Return the most memory that this process has had, in MB; None if the system does not tell. `ru_maxrss`
    is inherited from the process that started this one, so that on Linux another figure is used, which is
    not."""
    with suppress(OSError, ValueError, IndexError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return next(int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM:"))
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
