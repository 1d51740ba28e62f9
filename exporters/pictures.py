"""Export of pictures for compositing: a folder with one EXR file for each of a list of cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from exporters.formats.exr import exr_channels, exr_header, load_openexr, write_exr
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.errors import ConfigError
from player.files.files import new_folder
from player.progress import Progress, silent
from player.render import Renderer, check_size


def export_pictures(
    asset: Asset,
    target: Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    half: bool = False,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Render each camera with the asset's own number of feature lookups per ray, and write `target/NAME.exr`.

    Args:
        asset: an open asset.
        target: the new folder; it appears when every picture is in it.
        cameras: WORLD frame, at least one.
        names: names of the files without suffix, one per camera (`player.cameras.transforms.frame_names`).
        half: see `exporters.formats.exr`.
        force: replace a folder that exists.
        progress: called with the number done and the total after each picture.

    Returns:
        `pictures`, `channels` and `bytes`, described in `exporters.export.export_asset`.

    Raises:
        ConfigError: no camera, or a picture that is too large.
        OutputError, ParityError, MissingExtraError: as `exporters.formats.exr.write_exr`.
    """
    load_openexr()
    if not cameras:
        raise ConfigError("--views: expected at least one view, got none")
    for camera in cameras:
        check_size(camera.width, camera.height)
    n_bytes, written = 0, []
    with new_folder(target, force) as folder, Renderer(asset) as renderer:
        for done, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
            frame = renderer.render(camera, background="transparent", layers=True)
            channels = exr_channels(frame, camera, half)
            path = folder / f"{name}.exr"
            write_exr(path, channels, exr_header(camera))
            n_bytes, written = n_bytes + path.stat().st_size, list(channels)
            progress(done, len(cameras))
    return {"pictures": len(cameras), "channels": written, "bytes": n_bytes}
