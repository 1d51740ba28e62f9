"""Training on a GPU with the paper's settings: minutes, samples a second, PSNR, and where the time goes.

    python tests/benchmarks/bench_gpu.py nerf_synthetic/lego --json lego_gpu.json

The minutes include the first steps, in which code is generated; the profile is of steps at the end.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile, record_function

from vfr_bake.config import TrainConfig
from vfr_bake.data import load_scene
from vfr_bake.data.scene import evenly
from vfr_bake.evaluation import render_views
from vfr_bake.training.model_file import trained_model
from vfr_bake.training.trainer import StepReport, Trainer

PARTS = {
    "_draw": "rays drawn",
    "sample": "samples found",
    "_error": "field, compositing and head",
    "_backward": "gradients",
}
"""Methods that a step calls, and their names in the table. The rest of a step is its optimisers."""


@contextmanager
def named_parts(trainer: Trainer) -> Iterator[None]:
    """Show each part of a step in the profile under its name."""
    owners = {name: trainer._guide if name == "sample" else trainer for name in PARTS}

    def named(method: Any, title: str) -> Any:
        def call(*args: Any, **keywords: Any) -> Any:
            with record_function(title):
                result = method(*args, **keywords)
                torch.cuda.synchronize()  # else this part's work would count for the next one
                return result

        return call

    for name, owner in owners.items():
        setattr(owner, name, named(getattr(owner, name), PARTS[name]))
    yield
    for name, owner in owners.items():
        delattr(owner, name)


def profile_steps(trainer: Trainer, reports: Iterator[StepReport], n_steps: int) -> list[tuple[str, float]]:
    """Return (part, milliseconds a step), with the dearest GPU kernels, over `n_steps` more steps."""
    activities = [ProfilerActivity.CPU, ProfilerActivity.CUDA]
    n_done = 0
    with named_parts(trainer), profile(activities=activities) as recorded:
        with record_function("all of a step"):
            for _ in range(n_steps):
                n_done += next(reports, None) is not None
            torch.cuda.synchronize()
    events = recorded.key_averages()
    titles = ["all of a step", *PARTS.values()]
    parts = [
        (event.key, event.cpu_time_total / 1e3 / n_done)
        for title in titles
        for event in events
        if event.key == title and event.device_type == torch.autograd.DeviceType.CPU
    ]
    gpu = [event for event in events if event.device_type == torch.autograd.DeviceType.CUDA]
    gpu = [event for event in gpu if event.key not in titles]
    gpu.sort(key=lambda event: -event.self_device_time_total)
    return parts + [
        (f"  {event.key[:60]}", event.self_device_time_total / 1e3 / n_done) for event in gpu[:15]
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--batch-samples", type=int, default=2**18)
    parser.add_argument("--profiled-steps", type=int, default=50)
    parser.add_argument("--views", type=int, default=25, help="held-out views; 0 for all")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("bench_gpu.py: expected a GPU that torch can run CUDA on, got none")
    scene = load_scene(options.data, downscale=options.downscale)
    config = TrainConfig(device="cuda", steps=options.steps, batch_samples=options.batch_samples)
    trainer = Trainer(scene, config)
    n_samples, last = 0, None
    reports = trainer.run()
    n_trained = max(1, trainer.pace.steps - options.profiled_steps)
    begin = time.monotonic()
    for last in reports:
        n_samples += last.n_samples
        if sys.stderr.isatty() and last.step % 50 == 0:
            print(f"\r{last.progress:.0%}, loss {last.loss:.5f}", end="", file=sys.stderr)
        if last.step + 1 >= n_trained:
            break
    torch.cuda.synchronize()
    seconds = time.monotonic() - begin
    assert last is not None
    parts = profile_steps(trainer, reports, options.profiled_steps)
    figures = {
        "device": torch.cuda.get_device_name(),
        "minutes": seconds / 60,
        "steps": last.step + 1,
        "samples_per_second": n_samples / seconds,
        "gigabytes": torch.cuda.max_memory_allocated() / 1e9,
    }
    model, n_views = trained_model(trainer, scene, {}), len(scene.test.cameras)
    chosen = evenly(n_views, options.views or n_views)
    scores = [view.score() for view in render_views(model, scene.test, chosen)]
    figures["psnr"] = float(np.mean([score.psnr for score in scores])) if scores else None
    for name, value in figures.items():
        print(f"| {name} | {value if isinstance(value, str) or value is None else format(value, ',.2f')} |")
    whole = parts[0][1] if parts else 1.0
    print("\n| part of a step | ms | share |\n|---|---|---|")
    for title, milliseconds in parts:
        print(f"| {title} | {milliseconds:.3f} | {milliseconds / whole:.1%} |")
    if options.json is not None:
        options.json.write_text(json.dumps(figures | {"parts_ms": dict(parts)}, indent=1))


if __name__ == "__main__":
    main()
