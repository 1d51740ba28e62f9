"""The scripts in `examples/` do what they say, on a small asset."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

REPOSITORY = Path(__file__).resolve().parent.parent


def test_layers(shells_folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "layers.png"
    done = subprocess.run(
        [sys.executable, str(REPOSITORY / "examples" / "layers.py"), str(shells_folder), str(target)],
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{target}: ") and "of the pixels show the scene" in done.stdout
    with Image.open(target) as picture:
        assert picture.size == (4 * 400, 400)
        layers = np.split(np.asarray(picture).astype(int), 4, axis=1)
    opacity, depth, normals = layers[1][..., 0], layers[2][..., 0], layers[3]
    solid = opacity > 250
    assert 0.05 < solid.mean() < 0.9 and not depth[opacity < 100].any() and np.ptp(depth[solid]) > 200
    length = np.linalg.norm(normals[solid] / 127.5 - 1, axis=-1)
    assert np.abs(length - 1).mean() < 0.02


def test_every_example_is_run_here() -> None:
    assert [path.name for path in (REPOSITORY / "examples").glob("*.py")] == ["layers.py"]
