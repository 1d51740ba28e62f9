"""Scenes that are measured: trained, scored and baked, each step by a command that users have."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from tests.benchmarks.suite.work import Work
from vfr_bake.demo import TRAIN_MINUTES

SEED = 0
"""Default seed of the commands."""


@dataclass(frozen=True)
class Scene:
    """A data set, and how it is measured."""

    name: str
    data: str
    """Folder of the data set, or "demo"."""
    minutes: float | None = None
    """Minutes of training; None for the command's default."""
    reading: tuple[str, ...] = ()
    """Options of vfr-train about reading the pictures."""
    unbounded: bool = False
    photographs_alone: bool = False
    """True if its cameras are left out, so that they are estimated."""
    size: str = "800x800"
    """Pixels of the frames that are timed."""
    views: int = 25
    """Largest number of test views for the trade."""
    frames: int = 12
    """Number of timed frames of a setting, enough for the median of the trade."""


SCENES = {
    scene.name: scene
    for scene in (
        Scene("lego", "lego_400", 9.25),
        Scene("fox", "fox", reading=("--downscale", "2"), unbounded=True, size="540x960", frames=6),
        Scene("can", "can", unbounded=True, photographs_alone=True, size="720x1280", frames=6),
        Scene("demo", "demo", TRAIN_MINUTES),
    )
}


def data_of(work: Work, scene: Scene) -> str:
    """Return the argument DATA of the commands."""
    if scene.photographs_alone and not work.quick:
        return str(work.file(f"train_{scene.name}", "photos"))
    return work.data(scene.data)


def train(work: Work, scene: Scene, minutes: float | None = None, seed: int = SEED) -> dict[str, Any]:
    """Train a scene, from photographs alone if it is measured so; `minutes` replaces the scene's."""
    data = data_of(work, scene)
    if scene.photographs_alone and not work.quick:
        shutil.copytree(Path(work.data(scene.data)) / "images", Path(data) / "images")
    model, report = work.folder / "model.pt", work.folder / "train.json"
    minutes = minutes or scene.minutes
    length = () if minutes is None else ("--minutes", f"{minutes:g}")
    settings = (*scene.reading, *length, "--seed", str(seed), "--eval-views", "0")
    if work.quick and scene.unbounded:  # the data in place of its pictures show an object
        settings = ("--kind", "unbounded", *settings)
    usage = work.command("vfr-train", data, model, *settings, "--json", report)
    work.seeds.append(seed)
    trained = work.read("train.json")
    return {
        "steps": trained["steps"],
        "training_seconds": trained["seconds"],
        "ended_early": trained["ended_early"],
        **usage._asdict(),
    }


def score(work: Work, scene: Scene, model_of: str) -> dict[str, Any]:
    """Compare the full model of the part `model_of` with all test views."""
    model = work.file(model_of, "model.pt")
    usage = work.command("vfr-eval", model, data_of(work, scene), "--json", work.folder / "eval.json")
    found = work.read("eval.json")
    every = [view["psnr"] for view in found["per_view"]]
    return {
        "psnr": found["psnr"],
        "psnr_uncertainty": uncertainty_of_mean(every),
        "psnr_worst": min(every),
        "ssim": found["ssim"],
        "n_views": found["n_views"],
        **usage._asdict(),
    }


def bake(work: Work, model_of: str, *options: str) -> dict[str, Any]:
    """Bake the model of the part `model_of`."""
    asset = work.folder / "asset"
    report = work.folder / "bake.json"
    usage = work.command("vfr-bake", work.file(model_of, "model.pt"), asset, *options, "--json", report)
    baked, told = work.read("bake.json"), work.read("asset/report.json")
    manifest = work.read("asset/manifest.json")
    last = told["stages"][-1]
    return {
        "n_bytes": sum(told["bytes"].values()),
        "bytes": told["bytes"],
        "loss_db": baked["loss_db"],
        "loss_db_spread": baked["loss_db_spread"],
        "psnr_to_model": baked["psnr_to_full_model"],
        "n_vertices": baked["n_vertices"],
        "resolution": manifest["resolution"],
        "feature_resolution": manifest["feature_resolution"],
        "n_channels": manifest["n_channels"],
        "n_fetches": manifest["n_fetches"],
        "samples_median": last["samples_median"],
        "samples_p95": last["samples_p95"],
        "lookups": told["lookups"],
        "stages_seconds": told["seconds"],
        "missed": told["missed"],
        **usage._asdict(),
    }


def uncertainty_of_mean(values: list[float]) -> float | None:
    """Return half of the 95 % interval around a mean, from the values' own spread, by Student's t.

    >>> round(uncertainty_of_mean([1.0, 2.0, 3.0, 4.0]), 3)
    2.054
    >>> uncertainty_of_mean([1.0])
    """
    if len(values) < 2:
        return None
    return float(stdtrit(len(values) - 1, 0.975) * np.std(values, ddof=1) / np.sqrt(len(values)))
