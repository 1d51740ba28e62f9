"""What people have on disk, or the built-in scene -> posed views in the model's own frame."""

from __future__ import annotations

from pathlib import Path

from player.cameras.colmap import colmap_folder
from vfr_bake.config import SceneKind
from vfr_bake.data.demo import demo_capture
from vfr_bake.data.folders import has_transforms, load_folder
from vfr_bake.data.poses import has_pictures, is_video
from vfr_bake.data.scene import PosedImages, Scene, build_scene
from vfr_bake.data.threads import Progress

__all__ = ["PosedImages", "Scene", "load_scene"]


def load_scene(
    data: str | Path, progress: Progress | None = None, downscale: int = 1, kind: SceneKind = "auto"
) -> Scene:
    """Load the posed pictures that `data` names.

    `data`: a folder with `transforms_train.json` (NeRF-synthetic), `transforms.json` (instant-ngp,
    nerfstudio) or a COLMAP model (`sparse/0`), or the word `demo` for the built-in scene (a folder of that
    name is `./demo`). `progress`: called with the number of pictures done and to do. `downscale`: pictures
    are reduced by this factor along each side. `kind`: object or unbounded, or found from the pictures.

    Raises DataError or FormatError in one line that names the file and what was expected.
    """
    capture = demo_capture(progress=progress) if str(data) == "demo" else load_folder(Path(data), progress)
    return build_scene(capture, kind, downscale)


def needs_cameras(data: str | Path) -> bool:
    """Whether `data` is a video, or a folder of pictures without cameras: `poses.estimate_cameras` finds
    them."""
    folder = Path(data)
    if str(data) == "demo":
        return False
    if is_video(folder):
        return True
    known = not folder.is_dir() or has_transforms(folder) or colmap_folder(folder) is not None
    return not known and has_pictures(folder)
