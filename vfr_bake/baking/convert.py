"""Convert an asset to the current version of the format, without the model. The values stay the same, take
fewer bytes, and get coarser levels beneath, so that the asset's first part already shows a picture. The mesh
is made again, as the bake makes it, because meshes of earlier versions have any size."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

from exporters.formats.ply import small_ply_bytes
from exporters.surface.few_faces import RESOLUTION
from player.asset.asset import Asset, GridArrays, write_asset
from player.asset.target import check_asset_target
from player.files.memory import allowed_bytes
from player.progress import Progress, silent
from vfr_bake.baking.coarser_levels import with_coarser_levels
from vfr_bake.baking.limits import file_sizes
from vfr_bake.baking.mesh import bake_mesh, mesh_bytes

STEPS = 6
"""Number of steps that are reported to `progress`."""


@dataclass(frozen=True)
class Converted:
    """The result of a conversion."""

    asset: Asset
    """The asset that was read."""
    n_bytes_before: int
    n_bytes: int
    """Bytes of all files of the asset that was read, and of the new one, but the reports."""
    seconds: float


def convert(
    old: Path, new: Path, max_memory: float | None, force: bool = False, progress: Progress | None = None
) -> Converted:
    """Write the asset in `old`, of version 3 or 4, to the folder `new` as version 4.

    Head, cameras, reports and settings stay unchanged, and so does every value of the finest level. The mesh
    is made again.

    Args:
        old: the folder of an asset; every file in it has to be complete.
        new: the folder to write.
        max_memory: gigabytes that the asset may take in memory; None allows half of the machine's memory.
        force: replace `new` if it exists, and holds an asset and nothing else.
        progress: called with (steps done, steps in all).

    Raises:
        FormatError, IntegrityError: `old` is not an asset, or one of its files is broken.
        ConfigError: the asset takes more memory than is allowed.
        OutputError: `new` exists, or holds something else than an asset, or cannot be written.
    """
    begin = time.perf_counter()
    tell = progress or (lambda done, total: None)
    check_asset_target(new, force)
    asset = Asset.open(old, verify=True, max_memory=max_memory)
    tell(1, STEPS)
    densities = with_coarser_levels(asset.arrays.densities, "densities")
    tell(2, STEPS)
    features = with_coarser_levels(asset.arrays.features, "features")
    tell(3, STEPS)
    manifest = replace(asset.manifest, parts=(), files={})
    n_levels = len(densities.values)
    if len(manifest.level_steps) < n_levels:
        steps = (1,) * n_levels
        manifest = replace(manifest, level_steps=steps, density_steps=steps)
    if len(manifest.feature_steps) < len(features.values):
        manifest = replace(manifest, feature_steps=(1,) * len(features.values))
    head, cameras = asset.read("head.onnx"), asset.read("cameras.json")
    reports = {name: asset.read(name) for name in asset.manifest.files if name.startswith("report.")}

    def finish(folder: Path) -> dict[str, bytes]:
        """Return the mesh and the reports as files."""
        tell(4, STEPS)
        sizes = file_sizes(folder)
        most = mesh_bytes(sum(sizes.values()) - sizes["mesh.ply"], None)
        written = Asset.open(folder, max_memory=max_memory)
        baked = bake_mesh(written, RESOLUTION, most, allowed_bytes(max_memory) / 1e9, silent)
        return reports | {"mesh.ply": small_ply_bytes(baked.mesh)}

    write_asset(new, manifest, GridArrays(densities, features), head, None, cameras, force, finish)
    tell(STEPS, STEPS)
    n_bytes_before, n_bytes = (sum(file_sizes(folder).values()) for folder in (old, new))
    return Converted(asset, n_bytes_before, n_bytes, time.perf_counter() - begin)
