"""Measurement of every setting of some assets: quality against the photographs and the full
model, time, bytes and memory.

After the assets' first pictures the full model renders, in a process that ends before frames are timed. Then
one process per asset plays it: first all pictures, for quality, then frames in turns with the other
processes, for time (`vfr_bake.bench.timing`). If there is no time for the model's pictures, or for those of
the assets, fewer views are compared.
"""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from player.asset.asset import Asset
from player.asset.manifest import NAME
from player.cameras.camera import Camera
from player.cameras.transforms import write_cameras
from player.cameras.views import asset_cameras
from player.errors import ConfigError
from player.progress import Report
from player.render import fetches_used
from player.terminal import command_line
from player.threads import bounded_threads
from vfr_bake.baking.report import Pictures
from vfr_bake.bench.commands import bake_command, play_command
from vfr_bake.bench.process import Process
from vfr_bake.bench.result import Setting, Trade, conclude
from vfr_bake.bench.timing import Dials, Size, frame_times, measure_times
from vfr_bake.bench.worst import WorstPixel, worst_pixels
from vfr_bake.config import BenchConfig
from vfr_bake.data import check_settings, load_scene_as
from vfr_bake.data.scene import evenly
from vfr_bake.evaluation import RenderedView, beside_photograph
from vfr_bake.training.model_file import load_model
from vfr_bake.training.scores.metrics import Distance, mean, mean_scores, psnr, ssim
from vfr_bake.training.scores.views import Learned, scored_views, spread_order

N_FIRST_PICTURES = 3
"""Number of times that an asset is opened to time its first picture; the median counts."""
MODEL_FRAMES = 3
"""Frames of the full model at each size except the photographs' own, at which every view is rendered."""
SHARE = 1 / 3
"""Share of the minutes that the full model may take, and that the pictures for quality may take."""


@dataclass(frozen=True)
class Views:
    """Photographs that the quality is measured against."""

    cameras: list[Camera]
    """Cameras of the views, in the world frame."""
    background: np.ndarray
    """[3] float32 in [0, 1], the colour behind the assets."""
    photographs: list[np.ndarray]
    """[h, w, 4] uint8 each."""
    masked: bool
    """True if pixels that are not opaque are masked."""
    exposure: bool
    """True if the model was trained with an exposure for each picture. The exposure of a view is then fitted
    on its left half, and the right half is scored, as `vfr-eval` does."""

    def first(self, n_views: int) -> Views:
        """Return the first views."""
        return replace(self, cameras=self.cameras[:n_views], photographs=self.photographs[:n_views])

    def beside(self, pictures: list[np.ndarray]) -> list[RenderedView]:
        """Return the pictures [h, w, 4], one per view with colours over the background and opacity, in the
        form in which they are compared with the photographs."""
        views = []
        for camera, picture, rgba in zip(self.cameras, pictures, self.photographs, strict=True):
            rendered = picture[..., :3], picture[..., 3].reshape(-1)
            settings = self.background, self.exposure, self.masked
            views.append(beside_photograph(camera.name, *rendered, rgba, *settings))
        return views


def measure_trade(config: BenchConfig, lpips: Distance | None, progress: Report) -> Trade:
    """Play the assets with every k and quality at every size, and return what was measured; `progress` is
    called with (stage, done, of).

    Raises ConfigError, DataError or FormatError: an asset, the model or the data cannot be used, or cameras
    of equal name in them differ, so that they are not of one scene.
    """
    begin, most_seconds = time.monotonic(), 60 * SHARE * config.minutes
    assets = {  # opened whole, because figures of a part would be reported as those of the asset
        str(folder): Asset.open(folder, verify=True, max_memory=config.max_memory) for folder in config.assets
    }
    views, notes = _read_views(config, list(assets.values()), progress)
    n_views = len(views.cameras)
    own = views.cameras[0].width, views.cameras[0].height
    half_and_twice = [((own[0] + 1) // 2, (own[1] + 1) // 2), (2 * own[0], 2 * own[1])]
    sizes = list(dict.fromkeys([own, *(config.frame_sizes() or half_and_twice)]))
    dials = _all_dials(config, list(assets.values()))
    with tempfile.TemporaryDirectory(prefix="vfr-bench-") as folder, ExitStack() as stack:
        run = _Run(Path(folder), views, config, lpips, progress)
        first, frame_seconds = run.first_pictures(list(assets), own)
        scored = len(assets) * (1 if config.model is None else 2)
        seconds_a_view = len(dials[0]) * (frame_seconds + scored * run.score_seconds())
        run.views = views.first(max(1, int(min(n_views, most_seconds / seconds_a_view))))
        model, full = None, None
        if config.model is not None:
            model, full, scaled = run.model(config.model, sizes, config.data, most_seconds)
            notes += scaled
        views = run.views
        if len(views.cameras) < n_views:
            notes.append(
                f"compared {len(views.cameras)} of {n_views} test views, because there is no time for more "
                f"in {config.minutes:g} minutes: for more, raise --minutes, or give --samples"
            )
        players = [stack.enter_context(run.player(name)) for name in assets]
        qualities = [
            run.quality(name, asset, player, own_dials, full)
            for (name, asset), player, own_dials in zip(assets.items(), players, dials, strict=True)
        ]
        times = measure_times(
            [player.ask for player in players],
            len(views.cameras),
            sizes,
            dials,
            config.frames,
            begin + 60 * config.minutes,
            lambda done, of: progress("frame times", done, of),
        )
        played = players[0].ask(view=0, size=own, **dials[0][0].request(), rgb=None)
    rows = [
        Setting(
            name=f"{name} k={k or 'all'}{'' if some.quality == 'exact' else ' ' + some.quality}",
            asset=name,
            n_fetches=k,
            quality=some.quality,
            what=describe(asset),
            scores=qualities[index].scores[some],
            times={size: times[index, some, size] for size in sizes},
            n_bytes=played_bytes(asset),
            peak_mb=qualities[index].peak_mb,
            first_picture_ms=first[index],
            commands=(bake_command(name, asset), play_command(name, k, some.quality, own)),
        )
        for index, (name, asset) in enumerate(assets.items())
        for some in dials[index]
        for k in [fetches_used(asset, some.n_fetches, some.quality)]
    ]
    settings, sentence, recommended = conclude(rows, model)
    conditions = {
        "data": config.data,
        "model": None if config.model is None else str(config.model),
        "views": [camera.name for camera in views.cameras],
        "frames_a_setting_and_size": next(iter(times.values())).frames,
        "threads": played["threads"],
        "march": played["march"],
        "front_at": list(own),
        "background": views.background.tolist(),
        "bits": 8,
        "exposure_fitted": views.exposure,
        "notes": notes,
    }
    pictures = [quality.worst_view for quality in qualities]
    worst = {quality.worst_view.name: quality.worst for quality in qualities}
    return Trade(settings, sentence, recommended, sizes, conditions, pictures, worst)


@dataclass(frozen=True, eq=False)
class _Quality:
    """Scores of one asset's pictures, and where they are worst."""

    scores: dict[Dials, dict[str, float | None]]
    """Scores with each setting of the dials."""
    peak_mb: float | None
    worst_view: Pictures
    """The view with the lowest PSNR, with the asset's own k."""
    worst: list[WorstPixel]
    """The pixels with the largest errors, with the asset's own k."""


class _Run:
    """Views, settings and files that all measurements share."""

    def __init__(
        self, folder: Path, views: Views, config: BenchConfig, lpips: Distance | None, progress: Report
    ) -> None:
        self.views = views
        self._lpips = lpips
        self._progress = progress
        self._picture = folder / "picture.npy"
        self._cameras = folder / "cameras.json"
        self._cameras.write_bytes(write_cameras(views.cameras))
        self._threads = str(bounded_threads(config.threads) if config.threads else 0)
        self._max_memory = str(config.max_memory or 0)

    def player(self, name: str) -> Process:
        return Process("player", name, str(self._cameras), self._threads, self._max_memory)

    def model(
        self, path: Path, sizes: list[Size], data: str, most_seconds: float
    ) -> tuple[Setting, list[np.ndarray], list[str]]:
        """Return the full model's row, its pictures, one per view, and lines about what there was no time
        for. Only as many views as can be rendered within `most_seconds` are kept, but at least one, and sizes
        that would take longer get times that are scaled by the number of pixels."""
        n_views = len(self.views.cameras)
        pictures, own, lines = [], [], []
        with Process("model", str(path), str(self._cameras), self._threads, self._max_memory) as process:
            process.ask(view=0, size=[32, 32], rgb=None)
            begin = time.monotonic()
            for view, camera in enumerate(self.views.cameras):
                size = camera.width, camera.height
                own.append(process.ask(view=view, size=size, rgb=str(self._picture)))
                pictures.append(np.load(self._picture))
                self._progress("full model", len(own), n_views)
                if (time.monotonic() - begin) * (len(own) + 1) / len(own) > most_seconds:
                    break
            self.views = self.views.first(len(own))
            answers = {sizes[0]: own}
            for size in sizes[1:]:
                larger = size[0] * size[1] / (sizes[0][0] * sizes[0][1])
                expected = MODEL_FRAMES * larger * own[0]["ms"] / 1000
                if time.monotonic() - begin + expected <= most_seconds:
                    turns = [turn % len(own) for turn in range(MODEL_FRAMES)]
                    answers[size] = [process.ask(view=view, size=size, rgb=None) for view in turns]
                else:
                    answers[size] = [answer | {"ms": larger * answer["ms"]} for answer in own]
                    lines.append(
                        f"there was no time to render the full model at {size[0]}x{size[1]}: its "
                        f"milliseconds are those at {sizes[0][0]}x{sizes[0][1]}, scaled by the pixels"
                    )
        setting = Setting(
            name=str(path),
            asset=None,
            n_fetches=None,
            quality=None,
            what={"preset": "full model"},
            scores=self.scores(self.views.beside(pictures), pictures, None),
            times={size: frame_times(some, None, [1.0] * len(some)) for size, some in answers.items()},
            n_bytes=path.stat().st_size,
            peak_mb=answers[sizes[0]][-1]["peak_mb"],
            first_picture_ms=None,
            commands=(command_line("vfr-eval", str(path), data),),
        )
        return setting, pictures, lines

    def score_seconds(self) -> float:
        """Return the seconds that the scores of one picture take."""
        one = self.views.first(1)
        height, width = one.photographs[0].shape[:2]
        for _ in range(2):  # the first time, packages are imported
            start = time.perf_counter()
            for view in one.beside([np.zeros((height, width, 4), np.float32)]):
                view.score(self._lpips)
        return time.perf_counter() - start

    def first_pictures(self, names: list[str], size: Size) -> tuple[list[float], float]:
        """Return for each asset the milliseconds from starting a process to its first picture, and the
        seconds that a later one of all assets takes, with a lookup at every sample; the assets take turns."""
        request = {"view": 0, "size": size, "rgb": None, **Dials(1).request()}
        with self.player(names[0]) as process:  # compiles the code, if that has not been done before
            process.ask(**request)
        taken: list[list[float]] = [[] for _ in names]
        later = {}
        for turn in range(N_FIRST_PICTURES):
            for name, milliseconds in zip(names, taken, strict=True):
                start = time.perf_counter()
                with self.player(name) as process:
                    process.ask(**request)
                    milliseconds.append(1000 * (time.perf_counter() - start))
                    later[name] = process.ask(**request | Dials(0).request())["ms"]
            self._progress("first pictures", turn + 1, N_FIRST_PICTURES)
        return [float(np.median(milliseconds)) for milliseconds in taken], sum(later.values()) / 1000

    def quality(
        self, name: str, asset: Asset, player: Process, dials: list[Dials], full: list[np.ndarray] | None
    ) -> _Quality:
        """Score every view with all dials against the photographs, and against the model's pictures
        `full` if there are any."""
        scores: dict[Dials, dict[str, float | None]] = {}
        first = self.views.photographs[0][..., :3] / np.float32(255)
        worst_view, worst, peak = Pictures(name, first, first), [], None
        for done, some in enumerate(dials):
            pictures = []
            for view, photograph in enumerate(self.views.photographs):
                height, width = photograph.shape[:2]
                request = {"view": view, "size": [width, height], "rgb": str(self._picture)}
                answer = player.ask(**request, **some.request())
                pictures.append(np.load(self._picture))
                peak = answer["peak_mb"]
            beside = self.views.beside(pictures)
            scores[some] = self.scores(beside, pictures, full)
            if some == Dials(asset.manifest.n_fetches):
                wanted = [view.photograph for view in beside] if full is None else _colours(full)
                shown = [view.rgb for view in beside] if full is None else _colours(pictures)
                lowest = int(np.argmin([psnr(a, b) for a, b in zip(wanted, shown, strict=True)]))
                worst_view = Pictures(name, wanted[lowest], shown[lowest])
                worst = worst_pixels(asset, self.views.cameras, wanted, shown)
            self._progress(f"quality of {name}", done + 1, len(dials))
        return _Quality(scores, peak, worst_view, worst)

    def scores(
        self, beside: list[RenderedView], pictures: list[np.ndarray], full: list[np.ndarray] | None
    ) -> dict[str, float | None]:
        """Return the means of the scores over the views."""
        means = mean_scores([view.score(self._lpips) for view in beside])
        for name, score in (("psnr_to_model", psnr), ("ssim_to_model", ssim)):
            pairs = None if full is None else zip(_colours(pictures), _colours(full), strict=True)
            means[name] = None if pairs is None else mean([score(a, b) for a, b in pairs])
        return means


def _colours(pictures: list[np.ndarray]) -> list[np.ndarray]:
    return [picture[..., :3] for picture in pictures]


def _all_dials(config: BenchConfig, assets: list[Asset]) -> list[list[Dials]]:
    """Return the dials to measure of each asset: exact pictures with every k, and the other qualities with
    the asset's own k."""
    own = [asset.manifest.n_fetches for asset in assets]
    every = [Dials(k) for k in sorted({*config.samples, *own}, key=lambda k: k or 1e9)]
    return [[*every, Dials(k, "high"), Dials(k, "fast")] for k in own]


def describe(asset: Asset) -> dict[str, Any]:
    """Return what an asset is made of, as far as its manifest says."""
    manifest, baked = asset.manifest, asset.manifest.provenance.get("bake")
    baked = baked if isinstance(baked, dict) else {}  # the provenance has no fixed form
    width = baked.get("head_width")
    return {
        "preset": baked.get("preset"),
        "head": "the model's own" if width == 0 else None if width is None else f"{width} wide",
        "head_bits": baked.get("head_bits"),
        "resolution": manifest.resolution,
        "n_channels": manifest.n_channels,
        "code_levels": baked.get("code_levels"),
        "n_fetches": manifest.n_fetches,
    }


def played_bytes(asset: Asset) -> int:
    """Return the bytes of the manifest and of all files that it lists, except the reports, which no player
    reads."""
    files = asset.manifest.files.items()
    listed = sum(entry.bytes for name, entry in files if not name.startswith("report."))
    return listed + (asset.folder / NAME).stat().st_size


def _read_views(config: BenchConfig, assets: list[Asset], progress: Report) -> tuple[Views, list[str]]:
    """Return the views to compare, in an order of which every beginning is spread evenly, and lines to
    print."""
    train = assets[0].manifest.provenance.get("train", {})
    check_settings(train, f"{assets[0].folder}: provenance: train")
    scene = load_scene_as(
        train,
        assets[0].manifest.contracted,
        config.data,
        lambda done, of: progress("reading pictures", done, of),
    )
    exposure = any(_exposure_learned(asset.manifest.provenance) for asset in assets)
    learned = [Learned(str(asset.folder), asset_cameras(asset), asset.world_from_model) for asset in assets]
    if config.model is not None:
        model = load_model(config.model, config.max_memory)
        learned.append(Learned(str(config.model), model.cameras, model.world_from_model))
    views, lines = scored_views(scene, config.data, exposure, learned)
    some = evenly(len(views.cameras), config.views)
    chosen = some[spread_order(len(some))]
    backgrounds = {asset.manifest.background for asset in assets}
    if len(backgrounds) > 1:
        raise ConfigError(f"assets: expected one background, got {sorted(backgrounds)}")
    background = np.array(backgrounds.pop(), np.float32)
    photographs = [views.images[int(i)] for i in chosen]
    cameras = [views.cameras[i] for i in chosen]
    return Views(cameras, background, photographs, scene.masked, exposure), lines


def _exposure_learned(provenance: dict[str, Any]) -> bool:
    """Return whether training found that the exposure changes from picture to picture. The provenance of an
    asset has no fixed form, so its types are checked."""
    trained = provenance.get("trained")
    effects = trained.get("effects") if isinstance(trained, dict) else None
    return isinstance(effects, dict) and effects.get("exposure") is True
