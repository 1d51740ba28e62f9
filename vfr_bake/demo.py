"""`make demo`: from pictures to playback on the built-in scene, with what it measured at the end.

python -m vfr_bake.demo --output demo
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from player.app.commands import run
from player.app.option_types import number
from player.child import python_command
from player.files.files import check_target, write_bytes

TRAIN_MINUTES = 2.0
"""Default training time in minutes, compiling included: two cores with AVX2 reach 34 dB in it."""
REFINE_STEPS = 600
"""Steps of the first round of refinement, a compromise between 500 and 1,000: with 1,000 the loss is 0.1 dB
less here, and the bake takes a quarter of a minute longer with AVX-512."""
N_SHOWN = 4
"""Number of test views in the side-by-side picture."""


def main(argv: Sequence[str] | None = None) -> int:
    """Train, bake and play the demo scene into a folder; the last lines on stdout say where the results are
    and how good they are."""
    parser = argparse.ArgumentParser("python -m vfr_bake.demo", description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("demo"), help="folder to write (default: demo)")
    parser.add_argument(
        "--minutes",
        type=number("minutes", "2.5", above=0),
        default=TRAIN_MINUTES,
        help="training time (default: %(default)s)",
    )
    parser.add_argument("--force", action="store_true", help="replace what an earlier demo wrote")
    options = parser.parse_args(argv)
    return run("demo", lambda: _demo(options.output, options.minutes, options.force))


def _demo(output: Path, minutes: float, force: bool) -> int:
    from exporters.cli import main as export
    from player.app.cli import main as play
    from player.asset.asset import Asset
    from player.cameras.transforms import write_cameras
    from vfr_bake.cli import bake_main, train_main
    from vfr_bake.data import load_scene

    check_target(output / "model.pt", force, is_file=True)
    begin = time.monotonic()
    scene = load_scene("demo")
    cameras = [camera.transformed(scene.world_from_model) for camera in scene.test.cameras]
    write_bytes(output / "cameras_test.json", write_cameras(cameras))
    forced = ["--force"] if force else []

    def run(name: str, command: Callable[[list[str]], int], *arguments: str) -> float:
        print(f"\n== {name} ==  {' '.join(arguments)}", file=sys.stderr)
        start = time.monotonic()
        code = command([*arguments, *forced])
        if code:
            sys.exit(code)
        return time.monotonic() - start

    model, asset, frames = (str(output / name) for name in ("model.pt", "asset", "frames"))
    with bake_compiled_beside():
        trained = run("vfr-train", train_main, "demo", model, "--minutes", str(minutes),
                      "--json", f"{output}/train.json")  # fmt: skip
    seconds = {
        "train": trained,
        "bake": run("vfr-bake", bake_main, model, asset, "--refine-steps", str(REFINE_STEPS),
                    "--json", f"{output}/bake.json"),
        "play": run("vfr-play", play, asset, "--cameras", f"{output}/cameras_test.json", "--output", frames,
                    "--json", f"{output}/play.json"),
        "export": run("vfr-export", export, asset, f"{output}/mesh.glb")
        + run("vfr-export", export, asset, f"{output}/scene.html"),
    }  # fmt: skip
    figures = {name: json.loads((output / f"{name}.json").read_text()) for name in ("train", "bake", "play")}
    background = np.array(Asset.open(asset).manifest.background)
    played = _side_by_side(scene, background, Path(frames), output / "side_by_side.png")
    seconds["all"] = time.monotonic() - begin
    print(_summary(output, seconds, played, **figures))
    return 0


@contextmanager
def bake_compiled_beside() -> Iterator[None]:
    """Compile what the bake will run, in another process, while this context lasts. On a fresh machine,
    training itself compiles for most of a minute, on one core. What is not compiled at the end of the
    context, the bake compiles itself."""
    from vfr_bake.baking.plan import is_compiled

    if is_compiled():
        yield
        return
    with TemporaryDirectory() as folder:  # a process that is terminated cannot remove its files
        rehearsal = subprocess.Popen(
            python_command("vfr_bake.rehearsal"),
            env=os.environ | {"TMPDIR": folder},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            yield
        finally:
            rehearsal.terminate()
            rehearsal.wait()


def _side_by_side(scene: Any, background: np.ndarray, frames: Path, target: Path) -> float:
    """Write one picture with photographs, over the `background` [3], above the played frames; return the mean
    PSNR in dB of all played test frames."""
    from PIL import Image

    from player.cameras.transforms import frame_names
    from player.files.images import write_png
    from vfr_bake.training.scores.metrics import over_background, psnr, to_8_bit

    names = frame_names(scene.test.cameras)
    photographs = [to_8_bit(over_background(image, background)) for image in scene.test.images]
    played = [np.asarray(Image.open(frames / f"{name}.png").convert("RGB")) for name in names]
    mean = float(np.mean([psnr(a / 255, b / 255) for a, b in zip(photographs, played, strict=True)]))
    chosen = np.linspace(0, len(names) - 1, N_SHOWN).round().astype(int)
    rows = [np.concatenate([pictures[i] for i in chosen], axis=1) for pictures in (photographs, played)]
    write_png(target, np.concatenate(rows))
    return mean


def _summary(
    output: Path,
    seconds: dict[str, float],
    played: float,
    train: dict[str, Any],
    bake: dict[str, Any],
    play: dict[str, Any],
) -> str:
    """Return lines that say where the results are and how good; `seconds` and figures are the commands'."""
    full = f", full model {train['test_psnr']:.2f} dB" if train.get("test_psnr") is not None else ""
    return (
        f"\npictures   {output / 'frames'} ({play['frames']} frames)\n"
        f"           {output / 'side_by_side.png'} (the scene's own pictures above, played below)\n"
        f"asset      {output / 'asset'}: {bake['megabytes']:.1f} MB;  mesh {output / 'mesh.glb'}\n"
        f"quality    {played:.2f} dB played against the test pictures{full}\n"
        f"speed      {1000 / play['ms_median']:.1f} frames/s at {play['width']}x{play['height']}, "
        f"{play['threads']} threads, {play['march']} march\n"
        f"time       {seconds['all']:.0f} s: train {seconds['train']:.0f}, bake {seconds['bake']:.0f}, "
        f"play {seconds['play']:.0f}, export {seconds['export']:.0f}\n"
        f"\nopen {output / 'scene.html'}"
    )


if __name__ == "__main__":
    sys.exit(main())
