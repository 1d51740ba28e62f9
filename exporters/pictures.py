"""Export of pictures for compositing: a folder with one EXR file for each of a list of cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from exporters.formats.exr import exr_channels, exr_header, load_openexr, write_exr
from exporters.formats.parity import COARSEST
from exporters.options import ExportOptions
from exporters.surface.marching_cubes import voxel_size
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.errors import ConfigError
from player.files.files import new_folder
from player.files.memory import allowed_bytes, check_memory
from player.progress import Progress
from player.render import Renderer, check_size

BYTES_A_PIXEL, BYTES_A_FEATURE = 230, 8
"""Memory of a picture while its channels are made, in bytes per pixel: so many, and so many for each channel
of the features. With 4 and 14 of these, 262 and 320 to 350 were measured."""


def export_pictures(
    asset: Asset,
    target: Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    options: ExportOptions,
    force: bool,
    progress: Progress,
) -> dict[str, Any]:
    """Render each camera with the asset's own number of feature lookups per ray, and write `target/NAME.exr`.

    If the world is so far from its origin that steps of float32 are over COARSEST of a voxel, the layer
    `position` and OpenEXR's own matrices are left out.

    Args:
        asset: an open asset.
        target: the new folder; it appears when every picture is in it.
        cameras: WORLD frame, at least one.
        names: names of the files without suffix, one per camera (`player.cameras.transforms.frame_names`).
        options: the settings, already checked for this format.
        force: replace a folder that exists.
        progress: called with the number done and the total after each picture.

    Returns:
        `pictures`, `channels` and `bytes`, described in `exporters.export.export_asset`.

    Raises:
        ConfigError: no camera, or a picture that is too large, or takes more memory than it may.
        OutputError, ParityError, MissingExtraError: as `exporters.formats.exr.write_exr`.
    """
    load_openexr()
    if not cameras:
        raise ConfigError("--views: expected at least one view, got none")
    for camera in cameras:
        check_size(camera.width, camera.height)
    n_pixels = max(camera.width * camera.height for camera in cameras)
    n_bytes_a_pixel = BYTES_A_PIXEL + BYTES_A_FEATURE * asset.manifest.n_channels
    check_memory(n_pixels * n_bytes_a_pixel, allowed_bytes(options.max_memory), f"{target}: a picture")
    places = _float32_holds_places(asset, cameras)
    n_bytes, written = 0, []
    with new_folder(target, force) as folder, Renderer(asset) as renderer:
        for done, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
            frame = renderer.render(camera, background="transparent", layers=True)
            channels = exr_channels(frame, camera, options.half, places)
            path = folder / f"{name}.exr"
            write_exr(path, channels, exr_header(camera, places))
            n_bytes, written = n_bytes + path.stat().st_size, list(channels)
            progress(done, len(cameras))
    return {"pictures": len(cameras), "channels": written, "bytes": n_bytes}


def _float32_holds_places(asset: Asset, cameras: Sequence[Camera]) -> bool:
    """Return whether float32 is fine enough for places of the scene and of the cameras (world frame)."""
    middles = [asset.world_from_model[:3, 3], *(camera.c2w[:3, 3] for camera in cameras)]
    step = float(np.spacing(np.float32(np.abs(middles).max())))
    return step <= COARSEST * voxel_size(asset.grid) * asset.scale
