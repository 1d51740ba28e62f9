"""What people have on disk, or the built-in scene -> posed views in the model's own frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from vfr_bake.data.demo import demo_scene
from vfr_bake.data.scene import PosedImages, Scene
from vfr_bake.data.transforms import load_folder

__all__ = ["PosedImages", "Scene", "load_scene"]


def load_scene(data: str | Path, progress: Callable[[int, int], object] | None = None) -> Scene:
    """Load the posed pictures that `data` names.

    `data`: a folder with `transforms_train.json` (NeRF-synthetic) or `transforms.json` (instant-ngp,
    nerfstudio), or the word `demo` for the built-in scene (a folder of that name is `./demo`). `progress`:
    called with the number of pictures done and to do.

    Raises DataError or FormatError in one line that names the file and what was expected.
    """
    if str(data) == "demo":
        return demo_scene(progress=progress)
    return load_folder(Path(data), progress)
