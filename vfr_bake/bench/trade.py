"""What every setting of some assets gives and takes: quality against the photographs and the full model,
time, bytes, memory.

The full model renders first, in a process that ends before anything is timed. Then one process plays each
asset: its pictures for quality, then frames in turns for time (`vfr_bake.bench.timing`).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.transforms import write_cameras
from player.errors import ConfigError, DataError
from player.render import bounded_threads
from vfr_bake.bench.commands import bake_command, eval_command, play_command
from vfr_bake.bench.process import Process
from vfr_bake.bench.result import Setting, Trade, conclude
from vfr_bake.bench.timing import Size, Times, measure_times, notch
from vfr_bake.bench.worst import WorstPixel, worst_pixels
from vfr_bake.config import BenchConfig
from vfr_bake.data import load_scene
from vfr_bake.training.metrics import (
    Distance,
    ViewScore,
    mean_scores,
    over_background,
    psnr,
    score_view,
    ssim,
)

N_FIRST_PICTURES = 3
"""Times that an asset is opened for its first picture; the median counts."""
MODEL_FRAMES = 3
"""Frames of the full model of each size but the photographs' own, of which there is one a view."""

Progress = Callable[[str, int, int], object]


@dataclass(frozen=True)
class Views:
    """Photographs that the quality is measured against."""

    cameras: list[Camera]
    """World frame."""
    background: np.ndarray
    """[3] float32 in [0, 1], the assets' own."""
    photographs: list[np.ndarray]
    """[h, w, 3] float32 in [0, 1], over the background."""


def measure_trade(config: BenchConfig, lpips: Distance | None, progress: Progress) -> Trade:
    """Play the assets, with every k, at every size; `progress` is called with what is done and how far.

    Raises ConfigError, DataError or FormatError: an asset, the model or the data cannot be used, or they are
    not of one scene.
    """
    assets = {str(folder): Asset.open(folder, max_memory=config.max_memory) for folder in config.assets}
    views = _read_views(config, list(assets.values()), progress)
    own = views.cameras[0].width, views.cameras[0].height
    sizes = list(dict.fromkeys([own, *(config.frame_sizes() or _around(own))]))
    ks = set(config.samples) | {asset.manifest.n_samples for asset in assets.values()}
    samples = sorted(ks, key=lambda k: k or 1e9)
    with tempfile.TemporaryDirectory(prefix="vfr-bench-") as folder, ExitStack() as stack:
        run = _Run(Path(folder), views, config, lpips, progress)
        model, full = (None, None) if config.model is None else run.model(config.model, sizes, config.data)
        first = run.first_pictures(list(assets), own)
        players = [stack.enter_context(run.player(name)) for name in assets]
        qualities = [
            run.quality(name, asset, player, samples, full)
            for (name, asset), player in zip(assets.items(), players, strict=True)
        ]
        times = measure_times(
            [player.ask for player in players],
            len(views.cameras),
            sizes,
            samples,
            config.frames,
            lambda done, of: progress("frame times", done, of),
        )
        played = players[0].ask(view=0, size=own, samples=samples[0], rgb=None)
    rows = [
        Setting(
            name=f"{name} k={k or 'all'}",
            asset=name,
            samples=k,
            what=describe(asset),
            scores=qualities[index].scores[k],
            times={size: times[index, k, size] for size in sizes},
            n_bytes=played_bytes(asset),
            peak_mb=qualities[index].peak_mb,
            first_picture_ms=first[index],
            commands=(bake_command(name, asset), play_command(name, k, own)),
        )
        for index, (name, asset) in enumerate(assets.items())
        for k in samples
    ]
    settings, sentence = conclude(rows, model)
    conditions = {
        "data": config.data,
        "model": None if config.model is None else str(config.model),
        "views": [camera.name for camera in views.cameras],
        "frames_a_setting_and_size": config.frames,
        "threads": played["threads"],
        "march": played["march"],
        "front_at": list(own),
        "background": views.background.tolist(),
        "bits": 8,
    }
    pictures = {name: quality.worst_view for name, quality in zip(assets, qualities, strict=True)}
    worst = {name: quality.worst for name, quality in zip(assets, qualities, strict=True)}
    return Trade(settings, sentence, sizes, conditions, pictures, worst)


@dataclass(frozen=True, eq=False)
class _Quality:
    """One asset's pictures, compared."""

    scores: dict[int, dict[str, float | None]]
    """By k."""
    peak_mb: float | None
    worst_view: tuple[np.ndarray, np.ndarray]
    """Of the asset's own k: what was wanted and what was played."""
    worst: list[WorstPixel]


class _Run:
    """What all measurements share."""

    def __init__(
        self, folder: Path, views: Views, config: BenchConfig, lpips: Distance | None, progress: Progress
    ) -> None:
        self._views = views
        self._lpips = lpips
        self._progress = progress
        self._picture = folder / "picture.npy"
        self._cameras = folder / "cameras.json"
        self._cameras.write_bytes(write_cameras(views.cameras))
        self._threads = str(bounded_threads(config.threads) if config.threads else 0)
        self._max_memory = str(config.max_memory or 0)

    def player(self, name: str) -> Process:
        return Process(
            "vfr_bake.bench.player_frames", name, str(self._cameras), self._threads, self._max_memory
        )

    def model(self, path: Path, sizes: list[Size], data: str) -> tuple[Setting, list[np.ndarray]]:
        """The full model's row and its pictures, one a view."""
        own, n_views = sizes[0], len(self._views.cameras)
        pictures, times = [], {}
        with Process("vfr_bake.bench.model_frames", str(path), str(self._cameras), self._threads) as process:
            process.ask(view=0, size=[32, 32], rgb=None)
            milliseconds = []
            for view in range(n_views):
                answer = process.ask(view=view, size=own, rgb=str(self._picture))
                pictures.append(np.load(self._picture))
                milliseconds.append(answer["ms"])
                self._progress("full model", view + 1, n_views + MODEL_FRAMES * (len(sizes) - 1))
            times[own] = _whole_frames(milliseconds)
            peak = answer["peak_mb"]
            for index, size in enumerate(sizes[1:]):
                milliseconds = []
                for turn in range(MODEL_FRAMES):
                    milliseconds.append(process.ask(view=turn % n_views, size=size, rgb=None)["ms"])
                    done = n_views + MODEL_FRAMES * index + turn + 1
                    self._progress("full model", done, n_views + MODEL_FRAMES * (len(sizes) - 1))
                times[size] = _whole_frames(milliseconds)
        scores = self.scores(pictures, None)
        setting = Setting(
            name=str(path),
            asset=None,
            samples=None,
            what={"preset": "full model"},
            scores=scores,
            times=times,
            n_bytes=path.stat().st_size,
            peak_mb=peak,
            first_picture_ms=None,
            commands=(eval_command(str(path), data),),
        )
        return setting, pictures

    def first_pictures(self, names: list[str], size: Size) -> list[float]:
        """Milliseconds from starting a process to its first picture, by asset; their turns alternate."""
        request = {"view": 0, "size": size, "samples": 1, "rgb": None}
        with self.player(names[0]) as process:  # compiles, where that has not been done before
            process.ask(**request)
        taken: list[list[float]] = [[] for _ in names]
        for turn in range(N_FIRST_PICTURES):
            for name, milliseconds in zip(names, taken, strict=True):
                start = time.perf_counter()
                with self.player(name) as process:
                    process.ask(**request)
                    milliseconds.append(1000 * (time.perf_counter() - start))
            self._progress("first pictures", turn + 1, N_FIRST_PICTURES)
        return [float(np.median(milliseconds)) for milliseconds in taken]

    def quality(
        self, name: str, asset: Asset, player: Process, samples: list[int], full: list[np.ndarray] | None
    ) -> _Quality:
        """Every view with every k, against the photographs and the model's pictures if there are some."""
        wanted = self._views.photographs if full is None else full
        scores: dict[int, dict[str, float | None]] = {}
        worst_view, worst, peak = (wanted[0], wanted[0]), [], None
        for done, k in enumerate(samples):
            pictures = []
            for view, photograph in enumerate(self._views.photographs):
                height, width = photograph.shape[:2]
                answer = player.ask(view=view, size=[width, height], samples=k, rgb=str(self._picture))
                pictures.append(np.load(self._picture))
                peak = answer["peak_mb"]
            scores[k] = self.scores(pictures, full)
            if k == asset.manifest.n_samples:
                lowest = int(np.argmin([psnr(a, b) for a, b in zip(wanted, pictures, strict=True)]))
                worst_view = wanted[lowest], pictures[lowest]
                worst = worst_pixels(asset, self._views.cameras, wanted, pictures)
            self._progress(f"quality of {name}", done + 1, len(samples))
        return _Quality(scores, peak, worst_view, worst)

    def scores(self, pictures: list[np.ndarray], full: list[np.ndarray] | None) -> dict[str, float | None]:
        """Means over the views."""
        scores: list[ViewScore] = [
            score_view(camera.name, picture, photograph, self._lpips)
            for camera, picture, photograph in zip(
                self._views.cameras, pictures, self._views.photographs, strict=True
            )
        ]
        means = mean_scores(scores)
        pairs = [] if full is None else list(zip(pictures, full, strict=True))
        means["psnr_to_model"] = float(np.mean([psnr(a, b) for a, b in pairs])) if pairs else None
        means["ssim_to_model"] = float(np.mean([ssim(a, b) for a, b in pairs])) if pairs else None
        return means


def describe(asset: Asset) -> dict[str, Any]:
    """What an asset is made of, as far as its manifest says."""
    manifest, baked = asset.manifest, asset.manifest.provenance.get("bake", {})
    width = baked.get("head_width")
    return {
        "preset": baked.get("preset"),
        "head": "the model's own" if width == 0 else None if width is None else f"{width} wide",
        "head_bits": baked.get("head_bits"),
        "resolution": manifest.resolution,
        "n_channels": manifest.n_channels,
        "code_levels": baked.get("code_levels"),
        "n_samples": manifest.n_samples,
    }


def played_bytes(asset: Asset) -> int:
    """Bytes of every file but the reports, which no player reads."""
    files = asset.manifest.files.items()
    return sum(entry.bytes for name, entry in files if not name.startswith("report."))


def _read_views(config: BenchConfig, assets: list[Asset], progress: Progress) -> Views:
    downscale = assets[0].manifest.provenance.get("train", {}).get("downscale", 1)
    scene = load_scene(config.data, lambda done, of: progress("reading pictures", done, of), downscale)
    if not scene.test.cameras:
        raise DataError(f"{config.data}: test views: expected at least 1, got none")
    n_views = min(config.views, len(scene.test.cameras))
    chosen = np.linspace(0, len(scene.test.cameras) - 1, n_views).round().astype(int)
    cameras = [scene.test.cameras[i].transformed(scene.world_from_model) for i in chosen]
    backgrounds = {asset.manifest.background for asset in assets}
    if len(backgrounds) > 1:
        raise ConfigError(f"assets: expected one background, got {sorted(backgrounds)}")
    background = np.array(backgrounds.pop(), np.float32)
    return Views(cameras, background, [over_background(scene.test.images[i], background) for i in chosen])


def _around(size: Size) -> list[Size]:
    width, height = size
    return [((width + 1) // 2, (height + 1) // 2), (2 * width, 2 * height)]


def _whole_frames(milliseconds: list[float]) -> Times:
    """Times of frames that are not taken apart."""
    low, high = np.percentile(milliseconds, [25, 75])
    whole = float(np.median(milliseconds))
    return Times(
        median=whole,
        p95=float(np.percentile(milliseconds, 95)),
        quartiles=(float(low), float(high)),
        uncertainty=notch(np.array(milliseconds), [1.0] * len(milliseconds)),
        frames=len(milliseconds),
        march=0.0,
        lookups=None,
        head=0.0,
        rest=whole,
    )
