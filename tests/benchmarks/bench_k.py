"""What fewer lookups a ray cost: PSNR, SSIM and time against k, all else being equal.

    python tests/benchmarks/bench_k.py model.pt out/ --views 4 --json k.json

`out/` is an asset baked from `model.pt`. Pictures are those of views between the training cameras, which the
bake has not learned from, compared with the full model's; with `--data`, the test photographs as well. An
asset is refined for one k: bake with `--refine-steps 0` to see the choice of samples alone.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from PIL import Image

from player.asset import Asset
from player.cameras import Camera
from player.render import Renderer
from player.transforms import read_cameras
from vfr_bake.baking.views import views_between
from vfr_bake.rendering.render import render_image
from vfr_bake.training.metrics import over_background, psnr, ssim
from vfr_bake.training.model_file import load_model

VALUES = (1, 2, 3, 4, 5, 8, 12, 16, 32, 0)
SEED = 5
"""Of the views; the bake learns from and measures on others."""


def photographs(data: Path, n_views: int) -> tuple[list[Camera], list[np.ndarray]]:
    """Test cameras (world frame), spread evenly, and their pictures over white."""
    cameras = read_cameras(data / "transforms_test.json", size=(1, 1))
    cameras = [cameras[i] for i in np.linspace(0, len(cameras) - 1, n_views).round().astype(int)]
    pictures = [np.asarray(Image.open(data / f"{camera.name}.png").convert("RGBA")) for camera in cameras]
    height, width = pictures[0].shape[:2]
    names = {camera.name for camera in cameras}
    sized = [c for c in read_cameras(data / "transforms_test.json", size=(width, height)) if c.name in names]
    return sized, [over_background(picture, np.ones(3)) for picture in pictures]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    model, asset = load_model(options.model), Asset.open(options.asset)
    between = views_between(model, options.views, SEED)
    full = [render_image(model.field, model.occupancy, camera, model.background) for camera in between]
    cameras = [camera.transformed(model.world_from_model) for camera in between]
    white = (1.0, 1.0, 1.0)
    others, pictures = photographs(options.data, options.views) if options.data else ([], [])
    rows = []
    with Renderer(asset, options.threads) as renderer:
        renderer.render(cameras[0].resized(64, 64))
        for k in VALUES:
            times, frames = [], []
            for camera in cameras:
                begin = time.perf_counter()
                frames.append(renderer.render(camera, k, white))
                times.append(1000 * (time.perf_counter() - begin))
            shown = [renderer.render(camera, k, white).rgb for camera in others]
            taken = np.concatenate([frame.n_samples[frame.opacity > 1 / 512] for frame in frames])
            row = {
                "k": k or "all",
                "psnr_to_model": np.mean([psnr(f.rgb, m) for f, m in zip(frames, full, strict=True)]),
                "ssim_to_model": np.mean([ssim(f.rgb, m) for f, m in zip(frames, full, strict=True)]),
                "ms": np.median(times),
                "lookups_median": np.median(np.minimum(taken, k or taken)),
                "lookups_p95": np.percentile(np.minimum(taken, k or taken), 95),
            }
            if others:
                row["psnr"] = np.mean([psnr(a, b) for a, b in zip(shown, pictures, strict=True)])
                row["ssim"] = np.mean([ssim(a, b) for a, b in zip(shown, pictures, strict=True)])
            rows.append({name: value if name == "k" else float(value) for name, value in row.items()})
            print(
                "  ".join(
                    f"{name} {value:.4g}" if name != "k" else f"k {value}" for name, value in row.items()
                )
            )
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
