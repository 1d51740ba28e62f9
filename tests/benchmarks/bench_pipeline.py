"""The whole pipeline on a real scene, as a user runs it, with the figures that the README quotes.

    python tests/benchmarks/bench_pipeline.py ../shared/data/lego_400 --output /tmp/lego

Each command is a process of its own; peak memory is the operating system's. `--reuse` keeps a model or an
asset that is already in the output folder.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

from player.cameras.transforms import frame_names, read_cameras
from vfr_bake.training.scores.metrics import over_background, psnr, to_8_bit

COMMANDS = {
    "vfr-train": "import vfr_bake.cli as c; c.train_main()",
    "vfr-bake": "import vfr_bake.cli as c; c.bake_main()",
    "vfr-eval": "import vfr_bake.cli as c; c.eval_main()",
    "vfr-play": "import player.app.cli as c; c.main()",
    "vfr-export": "import exporters.cli as c; c.main()",
}


def run(name: str, *arguments: str) -> tuple[float, float]:
    """Seconds and peak megabytes of one command."""
    print(f"$ {name} {' '.join(arguments)}", file=sys.stderr, flush=True)
    begin = time.monotonic()
    process = subprocess.Popen([sys.executable, "-c", COMMANDS[name], *arguments])
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{name} failed")
    return time.monotonic() - begin, usage.ru_maxrss / 1000


def test_photographs(data: Path, background: np.ndarray) -> list[np.ndarray]:
    cameras = read_cameras(data / "transforms_test.json", size=(1, 1))
    rgba = [np.asarray(Image.open(data / f"{camera.name}.png").convert("RGBA")) for camera in cameras]
    return [to_8_bit(over_background(image, background)) / 255 for image in rgba]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--reuse", action="store_true")
    options = parser.parse_args()
    out = options.output
    out.mkdir(parents=True, exist_ok=True)
    model, asset, frames = out / "model.pt", out / "asset", out / "frames"
    cameras = options.data / "transforms_test.json"
    table = []
    if not (options.reuse and model.exists()):
        seconds, peak = run("vfr-train", str(options.data), str(model), "--force")
        table.append(("vfr-train", f"{seconds:.0f} s, {peak:.0f} MB at the peak"))
    run("vfr-eval", str(model), str(options.data), "--json", str(out / "eval.json"))
    full = json.loads((out / "eval.json").read_text())
    table.append(("full model, all test views", f"{full['psnr']:.2f} dB"))
    if not (options.reuse and asset.exists()):
        seconds, peak = run("vfr-bake", str(model), str(asset), "--force")
        table.append(("vfr-bake", f"{seconds:.0f} s, {peak:.0f} MB at the peak"))
    megabytes = sum(path.stat().st_size for path in asset.iterdir()) / 1e6
    table.append(("asset", f"{megabytes:.1f} MB"))
    view = ("--cameras", str(cameras), "--force")
    run("vfr-play", str(asset), *view, "--output", str(frames), "--json", str(out / "play.json"))
    for march, every in (("numba", 5), ("numpy", 25)):
        report, folder = out / f"play_{march}.json", str(out / f"frames_{march}")
        size = ("--size", "800x800", "--march", march, "--frames", f"0:200:{every}")
        run("vfr-play", str(asset), *view, "--output", folder, *size, "--json", str(report))
        figures = json.loads(report.read_text())
        rate = f"{1000 / figures['ms_median']:.2f} frames/s"
        times = f"{figures['ms_median']:.0f} ms median, {figures['ms_p95']:.0f} ms p95"
        table.append((f"vfr-play 800x800, {march}", f"{rate}: {times}, {figures['peak_rss_mb']:.0f} MB"))
    # Photographs are read last: a child's peak memory counts what its parent held when it was started.
    names = frame_names(read_cameras(cameras, size=(1, 1)))
    played = [np.asarray(Image.open(frames / f"{name}.png").convert("RGB")) / 255 for name in names]
    photographs = test_photographs(options.data, np.array(full["background"]))
    scores = [psnr(a, b) for a, b in zip(played, photographs, strict=True)]
    loss = full["psnr"] - np.mean(scores)
    table.append(("played, all test views", f"{np.mean(scores):.2f} dB, bake loss {loss:.2f} dB"))
    for name, value in table:
        print(f"| {name} | {value} |")


if __name__ == "__main__":
    main()
