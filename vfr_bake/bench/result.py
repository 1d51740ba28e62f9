"""The result of the bench: a row for every setting, whether it is on the front, and a recommendation."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from player.march.interpolation import Quality
from vfr_bake.baking.report import Pictures
from vfr_bake.bench.front import Point, pareto_front, recommend
from vfr_bake.bench.timing import Size, Times
from vfr_bake.bench.worst import WorstPixel

MAX_PSNR = 99.0
"""PSNR in dB that equal pictures, whose PSNR is infinite, count as."""


@dataclass(frozen=True)
class Setting:
    """One row of the trade."""

    name: str
    """Folder, k and quality of an asset, or the file of the model."""
    asset: str | None
    """The folder; None for the full model."""
    n_fetches: int | None
    """The most feature lookups per ray, k, which a quality may lower; 0 for one at every sample. None for the
    full model."""
    quality: Quality | None
    """Quality setting of the player. None for the full model."""
    what: dict[str, Any]
    """Properties of the asset: preset, head, resolution, channels and number formats."""
    scores: dict[str, float | None]
    """Means over the views. psnr, ssim, lpips (8-bit pictures), psnr_float, ssim_float: against the
    photographs. psnr_to_model, ssim_to_model: against the full model's unrounded pictures, None without one.
    loss_db: the loss of psnr against the full model, or without one against the best setting."""
    times: dict[Size, Times]
    n_bytes: int
    """Bytes of the asset without its reports, or of the model file."""
    peak_mb: float | None
    """Peak memory of the process that played it at the photographs' size, over all k, megabytes."""
    first_picture_ms: float | None
    """Milliseconds from starting a process to its first picture of the photographs' size, Python's start
    included, with numba's compiled code in its cache."""
    commands: tuple[str, ...]
    """The command that bakes the asset, if it keeps its settings, and the command that plays it."""
    on_front: bool = False

    @property
    def point(self) -> Point:
        """The setting as a point for the front, with its time at the first of the sizes."""
        first = next(iter(self.times.values()))
        quality = min(self.scores["psnr"] or 0.0, MAX_PSNR)
        return Point(self.name, quality, first.median, first.uncertainty, self.n_bytes / 1e6)


@dataclass(frozen=True, eq=False)
class Trade:
    """All rows, and the conclusions from them."""

    settings: list[Setting]
    recommendation: str
    recommended: list[Setting]
    """The settings that the recommendation names."""
    sizes: list[Size]
    """Sizes of the frames. The first is that of the first photograph, for which the front is found."""
    conditions: dict[str, Any]
    """Conditions of the measurement: views, rounds, threads, march."""
    pictures: list[Pictures] = field(default_factory=list)
    """The worst view of each asset, under the asset's name."""
    worst: dict[str, list[WorstPixel]] = field(default_factory=dict)
    """The worst pixels of each asset with its own k, by the asset's name."""

    def document(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return {
            "recommendation": self.recommendation,
            "recommended": [
                {"name": setting.name, "commands": setting.commands} for setting in self.recommended
            ],
            "conditions": self.conditions,
            "settings": [_plain(setting) for setting in self.settings],
            "worst_pixels": {name: [asdict(pixel) for pixel in some] for name, some in self.worst.items()},
        }


def conclude(settings: list[Setting], model: Setting | None) -> tuple[list[Setting], str, list[Setting]]:
    """Return all settings, the model's first, with their losses and places on the front, the sentence that
    recommends some, and these."""
    best = max(setting.point.psnr for setting in settings)
    reference = best if model is None else model.point.psnr
    every = settings if model is None else [model, *settings]
    front = pareto_front([setting.point for setting in every])
    told = [
        replace(setting, on_front=on, scores=setting.scores | {"loss_db": reference - setting.point.psnr})
        for setting, on in zip(every, front, strict=True)
    ]
    points = [setting.point for setting in settings]
    sentence, named = recommend(points, reference, "the full model" if model else "the best setting")
    return told, sentence, [settings[points.index(point)] for point in named]


def _plain(setting: Setting) -> dict[str, Any]:
    """Return a row as JSON values; an infinite PSNR is null."""
    row = asdict(setting)
    row["scores"] = {key: None if value == float("inf") else value for key, value in row["scores"].items()}
    row["times"] = {f"{width}x{height}": asdict(times) for (width, height), times in setting.times.items()}
    return row
