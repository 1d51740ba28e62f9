"""Limits on the asset's size and loss: what fits, and whether they were met."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from player.asset.asset import GridArrays
from player.asset.packing import pack_codes, pack_masks
from player.errors import TrainingError
from vfr_bake.config import BakeConfig

SMALL_FILES = 200_000
"""Bytes kept for a small head and the manifest where the asset has to fit into a budget."""
REFINED_GROWTH = 1.1
"""Refined codes are rougher than the field's, and pack less well."""


def bytes_beside_features(arrays: GridArrays, mesh: int, cameras: int, head: int) -> int:
    """Of an asset of these arrays, with a mesh, cameras and a head of so many bytes."""
    masks = (len(pack_masks(words)) for words in (arrays.brick_masks, arrays.feature_masks))
    coords = arrays.brick_coords.nbytes + arrays.feature_coords.nbytes
    return coords + sum(masks) + len(pack_codes(arrays.density)) + mesh + cameras + head


def channels_that_fit(max_mb: float, rest: int, sizes: list[int]) -> int:
    """How many channels, the most important first, fit into `max_mb` megabytes.

    `sizes` are the packed bytes of each channel before refinement, `rest` the bytes of everything else but
    the small files. Raises TrainingError where not even one does.

    >>> channels_that_fit(1.0, 300_000, [200_000] * 5)
    2
    """
    totals = rest + SMALL_FILES + REFINED_GROWTH * np.cumsum(sizes)
    n_fit = int(np.searchsorted(totals, max_mb * 1e6, "right"))
    if n_fit == 0:
        raise TrainingError(
            f"bake: size: expected at most {max_mb:g} MB, got {totals[0] / 1e6:.2f} MB with one channel: "
            "nothing was written: allow more, or lower --resolution or --mesh-resolution"
        )
    return n_fit


def file_sizes(folder: Path) -> dict[str, int]:
    """Bytes of each of the asset's files; the report is not among them."""
    paths = sorted(path for path in folder.iterdir() if path.stem != "report")
    return {path.name: path.stat().st_size for path in paths}


def check_budget(config: BakeConfig, loss_db: float, megabytes: float, ms: float | None) -> None:
    """Raise TrainingError where the written files miss what was asked; it says what came nearest. `ms` is the
    time of a frame, where that was asked."""
    limits = (
        ("loss", config.max_loss_db, loss_db, "dB"),
        ("size", config.max_mb, megabytes, "MB"),
        ("time", config.target_ms, ms, "ms"),
    )
    for name, limit, got, unit in limits:
        if limit is not None and got is not None and got > limit:
            raise TrainingError(
                f"bake: {name}: expected at most {limit:g} {unit}, got {got:.2f} {unit} ({loss_db:.2f} dB in "
                f"{megabytes:.1f} MB): nothing was written: allow more, or change the preset"
            )
