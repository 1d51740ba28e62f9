"""Data sets of 32x32 pixels in place of the real ones, to try out the machinery."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from PIL import Image

from player.cameras.transforms import write_cameras
from tests.benchmarks.suite.scenes import SCENES


def write_data_sets(root: Path) -> None:
    """Write the built-in scene as NeRF-synthetic, 12 views to train on and 2 to test, under every data set's
    name, unless `root` exists."""
    from vfr_bake.data.demo import demo_views  # only if something is written: numba takes memory

    if root.is_dir():
        return
    splits = list(zip(("train", "test"), demo_views(size=32, n_train=12, n_test=2), strict=True))
    for name in {*(scene.data for scene in SCENES.values()), "lego_800_train"}:
        for split, views in splits:
            (root / name / split).mkdir(parents=True)
            for index, image in enumerate(views.images):
                Image.fromarray(image).save(root / name / split / f"r_{index}.png")
            cameras = [replace(c, name=f"./{split}/r_{index}") for index, c in enumerate(views.cameras)]
            (root / name / f"transforms_{split}.json").write_bytes(write_cameras(cameras))
