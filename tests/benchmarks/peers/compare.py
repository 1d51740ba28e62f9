"""Compare another tool that trains without a GPU with this one: same views, machine, minutes and pixels.

    python -m tests.benchmarks.peers.compare DATA --nerfstudio NS/bin/python --minutes 2 5 10

NS is an environment of its own, with nerfstudio 1.1.5. Its nerfacto trains once and is evaluated after each
number of minutes, because its schedule does not depend on how long it will train. The schedule of vfr-train
does, so it trains once for each number of minutes. The seconds are all those that the steps took: vfr-train
does not count among its minutes what compiling adds to its first step, but here it counts. Both get the
pictures without lens distortion. Prints the PSNR of both over the same pixels of all test views, over white
if there is alpha: the mean over the views.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from PIL import Image

from vfr_bake.config import TrainConfig
from vfr_bake.data import load_scene
from vfr_bake.data.scene import Scene
from vfr_bake.rendering.render import render_rays
from vfr_bake.training.model_file import trained_model
from vfr_bake.training.scores.metrics import over_background, psnr
from vfr_bake.training.trainer import Trainer

WHITE = np.ones(3)
N_PIXELS = 20_000
"""Number of pixels that are compared in all test views together."""


class Mark(NamedTuple):
    """State of a training after some time."""

    steps: int
    seconds: float
    """All seconds that the steps took."""
    colours: np.ndarray
    """[n_views, n, 3] in [0, 1]: colours of the pixels that are compared."""


def write_nerfstudio(scene: Scene, folder: Path) -> None:
    """Write the pictures and cameras of an unbounded scene in nerfstudio's format, in which the names of the
    files say which pictures are held out."""
    (folder / "images").mkdir()
    frames = []
    for split, views in (("train", scene.train), ("eval", scene.test)):
        for number, camera in enumerate(views.cameras):
            path = f"images/frame_{split}_{number:05d}.png"
            Image.fromarray(views.images[number][..., :3]).save(folder / path)
            intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
            size = {"w": camera.width, "h": camera.height}
            frames.append({"file_path": path, "transform_matrix": camera.c2w.tolist()} | intrinsics | size)
    content = {"camera_model": "OPENCV", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def chosen_pixels(scene: Scene) -> np.ndarray:
    """Return the rows and columns of the pixels that are compared, [n_views, n, 2] int64."""
    generator = np.random.default_rng(0)
    n = N_PIXELS // len(scene.test.cameras)
    sizes = np.array([(camera.height, camera.width) for camera in scene.test.cameras])
    return generator.integers(0, sizes[:, None], size=(len(sizes), n, 2))


def ours(scene: Scene, minutes: float, places: np.ndarray) -> Mark:
    """Train with vfr-train for so many minutes, and return its state."""
    trainer = Trainer(scene, TrainConfig(device="cpu", minutes=minutes))
    begin = time.monotonic()
    for _ in trainer.run():
        pass
    seconds = time.monotonic() - begin
    model = trained_model(trainer, scene, {})
    colours = []
    for camera, pixels in zip(scene.test.cameras, places, strict=True):
        rays = camera.rays_through(pixels[:, 0] * camera.width + pixels[:, 1])
        shown, opacity = render_rays(model.field, model.sampler, *rays)
        colours.append(np.clip(shown + (1 - opacity[:, None]) * model.background, 0, 1))
    return Mark(trainer.next_step, seconds, np.stack(colours))


def nerfacto(scene: Scene, options: argparse.Namespace, places: np.ndarray) -> list[Mark]:
    """Train with nerfacto once, and return its state after each number of minutes."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        if scene.unbounded:
            write_nerfstudio(scene, folder)
        views = np.broadcast_to(np.arange(len(places))[:, None, None], (*places.shape[:2], 1))
        np.savez(folder / "pixels.npz", pixels=np.concatenate([views, places], axis=2).reshape(-1, 3))
        script = Path(__file__).with_name("nerfacto.py")
        data = [str(folder)] if scene.unbounded else [str(options.data.resolve()), "--object"]
        files = [str(folder / "pixels.npz"), str(folder / "colours.npz")]
        words = ["--minutes", *map(str, options.minutes), "--rays", str(options.rays)]
        subprocess.run([str(options.nerfstudio), str(script), data[0], *files, *data[1:], *words], check=True)
        with np.load(folder / "colours.npz", allow_pickle=False) as found:
            colours = found["colours"].reshape(-1, *places.shape[:2], 3)
            marks = zip(found["steps"].tolist(), found["seconds"].tolist(), colours, strict=True)
            return [Mark(*mark) for mark in marks]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--nerfstudio", type=Path, required=True, help="Python of its environment")
    parser.add_argument("--minutes", type=float, nargs="+", default=[2.0, 5.0, 10.0])
    parser.add_argument("--rays", type=int, default=4096, help="rays of nerfacto's batches; its default")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    options.minutes.sort()
    scene = load_scene(options.data, downscale=options.downscale)
    places = chosen_pixels(scene)
    pictures = [over_background(image, WHITE) for image in scene.test.images]
    wanted = np.stack([image[at[:, 0], at[:, 1]] for image, at in zip(pictures, places, strict=True)])
    found = {"nerfacto": nerfacto(scene, options, places)}
    found["vfr-train"] = [ours(scene, minutes, places) for minutes in options.minutes]
    print("| minutes | tool | steps | seconds | PSNR, dB |")
    print("|---|---|---|---|---|")
    figures = []
    for tool, marks in found.items():
        for minutes, mark in zip(options.minutes, marks, strict=True):
            reached = float(np.mean([psnr(*view) for view in zip(mark.colours, wanted, strict=True)]))
            print(f"| {minutes:g} | {tool} | {mark.steps} | {mark.seconds:.0f} | {reached:.2f} |")
            time = {"minutes": minutes, "steps": mark.steps, "seconds": mark.seconds}
            figures.append({"tool": tool, "psnr": reached} | time)
    if options.json is not None:
        options.json.write_text(json.dumps(figures), encoding="utf-8")


if __name__ == "__main__":
    main()
