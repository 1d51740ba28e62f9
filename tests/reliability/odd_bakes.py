"""Trains models of odd scenes for a short time, bakes each under several limits, and plays the assets.

    python -m tests.reliability.odd_bakes FOLDER [--scenes room fog] [--models model.pt ...] [--views 32]

Every bake has to give an asset that keeps to the memory and the bytes that were allowed, that opens with all
checksums compared, and that plays. Each runs as `vfr-bake` in a process of its own, whose peak of memory is
measured. One line is printed for each, and FOLDER/results.json holds them; the exit code is the number of
bakes that failed. `--models` adds models that were trained before, for example by `vfr-train DATA model.pt
--steps 500`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from player.asset.asset import Asset
from player.cameras.views import asset_cameras
from player.render import render
from tests.reliability.odd_scenes import ODD, odd_capture
from tests.vfr_bake.baking.scenes import trained
from vfr_bake.config import TrainConfig
from vfr_bake.data.scene import build_scene
from vfr_bake.training.model_file import save_model

FOGS = {"fog of 30 steps": ("glass", 30), "two views of 10 steps": ("two views", 10)}
"""Models that are hardly trained: their scene, and their number of steps."""
LIMITS = (
    ("balanced",),
    ("fast",),
    ("balanced", "--max-memory", "2"),
    ("fast", "--max-memory", "2"),
    ("balanced", "--max-mb", "3"),
    ("fast", "--max-mb", "3"),
)
MEMORY_GB, MAX_MB = re.compile("--max-memory ([0-9.]+)"), re.compile("--max-mb ([0-9.]+)")


@dataclass(frozen=True)
class OddBake:
    """Result of a bake."""

    model: str
    options: str
    failed: list[str]
    """Descriptions of what is wrong; empty if nothing is."""
    said: list[str]
    """Last lines of stderr."""
    seconds: float
    expected_seconds: float | None
    """Expected time that the bake printed at its beginning."""
    peak_gb: float
    megabytes: float
    loss_db: float | None
    psnr: float | None
    """PSNR in dB, compared with the model's own pictures."""
    left_out: dict[str, str]


def train_odd(folder: Path, names: list[str], size: int, n_views: int, minutes: float) -> list[Path]:
    """Return models of the scenes. Those that do not exist yet are trained for so many minutes each."""
    models = []
    for name in names:
        scene_name, steps = FOGS.get(name, (name, None))
        path = folder / f"{name.replace(' ', '_')}.pt"
        if not path.exists():
            scene = build_scene(odd_capture(scene_name, size, n_views))
            config = TrainConfig(device="cpu", minutes=minutes, steps=steps)
            save_model(path, trained(scene, config))
        models.append(path)
    return models


def bake_odd(model: Path, options: tuple[str, ...], folder: Path, refine_steps: int) -> OddBake:
    """Bake a model, and check the asset."""
    name = re.sub("[^a-z0-9]+", "_", f"{model.stem}_{'_'.join(options)}".lower())
    asset, log, figures = folder / name, folder / f"{name}.log", folder / f"{name}.json"
    command = [sys.executable, "-c", "import sys; from vfr_bake.cli import bake_main; sys.exit(bake_main())"]
    command += [str(model), str(asset), "--force", "--json", str(figures), "--preset", *options]
    command += ["--refine-steps", str(refine_steps)]
    figures.unlink(missing_ok=True)
    begin = time.monotonic()
    with log.open("w") as out:
        process = subprocess.Popen(command, stdout=out, stderr=out)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    seconds, peak = time.monotonic() - begin, used.ru_maxrss * 1024 / 1e9
    text = log.read_text()
    said = text.replace("\r", "\n").strip().splitlines()
    asked, failed = " ".join(options), []
    expected = re.search(r"about ([0-9.]+) minutes", text)
    allowed = float(found[1]) if (found := MEMORY_GB.search(asked)) else 4.0
    if peak > allowed:
        failed.append(f"took {peak:.2f} GB of memory, allowed {allowed:g}")
    known: dict[str, Any] = {}
    if process.returncode or not figures.exists():
        failed.append(f"exit code {process.returncode}")
    else:
        known = json.loads(figures.read_text())
        if (most := MAX_MB.search(asked)) and known["megabytes"] > float(most[1]):
            failed.append(f"{known['megabytes']:.2f} MB, allowed {most[1]}")
        failed += what_does_not_play(asset)
    return OddBake(
        model.stem, asked, failed, said[-3:], seconds, 60 * float(expected[1]) if expected else None, peak,
        known.get("megabytes", 0.0), known.get("loss_db"), known.get("psnr_to_full_model"),
        known.get("left_out", {}),
    )  # fmt: skip


def what_does_not_play(folder: Path) -> list[str]:
    """Return what is wrong with an asset: it does not open, or pictures are not finite or show nothing."""
    asset = Asset.open(folder, verify=True)
    seen = 0.0
    for camera in asset_cameras(asset)[:: max(len(asset_cameras(asset)) // 3, 1)]:
        frame = render(asset, camera.resized(64, 64))
        if not np.isfinite(frame.rgb).all():
            return ["its picture is not finite"]
        seen = max(seen, float(frame.opacity.max()))
    return [] if seen > 0 else ["it shows nothing"]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="*", default=[*ODD, *FOGS])
    parser.add_argument("--models", type=Path, nargs="*", default=[])
    parser.add_argument("--views", type=int, default=32)
    parser.add_argument("--size", type=int, default=96, help="pixels along a picture's side")
    parser.add_argument("--minutes", type=float, default=0.6, help="of training a scene")
    parser.add_argument("--refine-steps", type=int, default=60)
    parser.add_argument("--limits", nargs="*", help='limits, each in one word: "fast --max-mb 3"')
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    models = train_odd(arguments.folder, arguments.scenes, arguments.size, arguments.views, arguments.minutes)
    limits = LIMITS if arguments.limits is None else [tuple(text.split()) for text in arguments.limits]
    found = []
    for model in [*models, *arguments.models]:
        for options in limits:
            done = bake_odd(model, options, arguments.folder, arguments.refine_steps)
            found.append(vars(done))
            lost = "" if done.loss_db is None else f"{done.loss_db:.2f} dB lost"
            told = (
                f"{'FAILED' if done.failed else 'ok    '}  {done.model:24} {done.options:28} "
                f"{done.seconds:4.0f} s  {done.peak_gb:.2f} GB  {done.megabytes:6.2f} MB  {lost}"
            )
            worse = [*done.failed, *done.said] if done.failed else []
            sys.stdout.write("\n        ".join([told, *worse]) + "\n")
            sys.stdout.flush()
    (arguments.folder / "results.json").write_text(json.dumps(found, indent=1))
    return sum(bool(done["failed"]) for done in found)


if __name__ == "__main__":
    sys.exit(main())
