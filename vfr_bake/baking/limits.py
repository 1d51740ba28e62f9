"""What a bake was told to keep to, size, loss and the time of a frame: what fits, and whether it was met.

The time of a frame is measured by the player on this machine, with an asset that is not written yet.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from player.asset.asset import Asset, GridArrays
from player.asset.manifest import FileEntry, Manifest
from player.cameras.camera import Camera
from player.errors import TrainingError
from player.render import Renderer
from vfr_bake.config import BakeConfig
from vfr_bake.presets import BakeChoice

MANIFEST_BYTES = 20_000
"""Bytes kept for the manifest where the asset has to fit into a budget."""
CELL_BYTES = 0.1
"""Bytes that a stored cell of the features takes at least, with its densities: where there are fewer for
each, coarser grids show more."""
PAGE_CHANNEL_BYTES, PAGE_COLUMN_BYTES, PAGE_DENSITY_BYTES = 1.4, 5, 13
"""Bytes of graphics memory that a page takes for each cell of the features, roughly: for a channel, because
there are more vertices than cells; to find them; and for a density."""
FEWEST_CELLS = 4096
"""Cells that an asset has in any case: with fewer it shows nothing."""
SIZE = 800
"""Pixels along each side of the frame that is measured."""
N_FRAMES = 3
"""Frames of which the median counts; one before them warms up."""
WIDTHS = (64, 48, 32, 16)
"""Widths of smaller heads that are tried."""
LOOKUPS = (1, 2, 3, 4, 5, 8, 12, 16, 32)
"""Numbers of lookups a ray that are tried."""
RESERVE = 0.9
"""Share of the time asked for that a choice may take before refinement."""

Measure = Callable[[int, int], float]
"""Milliseconds of a frame by (width of the head, 0 for the model's own; lookups a ray, 0 for all)."""


def cells_that_fit(max_mb: float, others: int) -> int:
    """How many cells of the features may be stored in `max_mb` megabytes, of which MANIFEST_BYTES and
    `others` bytes are taken.

    >>> cells_that_fit(3.0, 300_000)
    26800000
    """
    return max(int((max_mb * 1e6 - others - MANIFEST_BYTES) / CELL_BYTES), FEWEST_CELLS)


def cells_of_page(page_mb: float, n_channels: int, densities_per_cell: float) -> int:
    """How many cells of the features may be stored if a page of the asset is to take no more than `page_mb`
    megabytes of graphics memory, roughly.

    >>> cells_of_page(512, 24, 1.0)
    9922480
    """
    of_features = PAGE_CHANNEL_BYTES * 4 * -(-n_channels // 4) + PAGE_COLUMN_BYTES
    return max(int(page_mb * 1e6 / (of_features + PAGE_DENSITY_BYTES * densities_per_cell)), FEWEST_CELLS)


def file_sizes(folder: Path) -> dict[str, int]:
    """Bytes of each of the asset's files; the report is not among them."""
    paths = sorted(path for path in folder.iterdir() if path.stem != "report")
    return {path.name: path.stat().st_size for path in paths}


def check_budget(config: BakeConfig, loss_db: float, megabytes: float, ms: float | None) -> None:
    """Raises TrainingError where the written files miss what was asked; it says what they reach. `ms` is the
    time of a frame, or None where that was not asked."""
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


def frame_ms(asset: Asset, camera: Camera, n_fetches: int) -> float:
    """Milliseconds of a frame of SIZE x SIZE seen by `camera` (WORLD frame), as the player plays it here."""
    times = []
    with Renderer(asset) as renderer:
        for _ in range(N_FRAMES + 1):
            begin = time.perf_counter()
            renderer.render(camera.resized(SIZE, SIZE), n_fetches)
            times.append(1000 * (time.perf_counter() - begin))
    return float(np.median(times[1:]))


def keep_to_time(
    choice: BakeChoice, target_ms: float, measure: Measure, same_head: bool, same_lookups: bool
) -> BakeChoice:
    """`choice` with the widest head, and then the most lookups, whose frames take no longer than `target_ms`.

    `same_head` and `same_lookups` say what stays because it was asked for by number. Raises TrainingError
    where even the least takes longer; it says how long.

    >>> from vfr_bake.presets import PRESETS
    >>> chosen = keep_to_time(PRESETS["balanced"], 100, lambda width, k: width + 6 * k, False, False)
    >>> chosen.head_width, chosen.n_fetches
    (64, 4)
    """
    fewest = choice.n_fetches if same_lookups else min(LOOKUPS)
    least = np.inf
    for width in (choice.head_width,) if same_head else _downwards(choice.head_width, WIDTHS):
        took = measure(width, fewest)
        least = min(least, took)
        if took > RESERVE * target_ms:
            continue
        for k in (fewest,) if same_lookups else _downwards(choice.n_fetches, LOOKUPS[::-1]):
            if k == fewest or measure(width, k) <= RESERVE * target_ms:
                return replace(choice, head_width=width, n_fetches=k)
    raise TrainingError(
        f"bake: time: expected a frame of {SIZE} x {SIZE} in at most {target_ms:g} ms, got {least:.0f} ms "
        "with the fewest lookups and the smallest head: nothing was written: allow more, or lower "
        "--resolution"
    )


def _downwards(most: int, tried: Sequence[int]) -> list[int]:
    """`most` and those of `tried`, in falling order, that are less; 0 is more than any number."""
    return [most, *(n for n in tried if n < most or not most)]


def unwritten_asset(folder: Path, manifest: Manifest, arrays: GridArrays, files: dict[str, bytes]) -> Asset:
    """The asset of `manifest` and `arrays`, which stay in memory.

    Args:
        folder: an empty folder; it must live as long as the asset.
        files: what is opened by its path, by name: `{"head.onnx": ..., "cameras.json": ...}`; only they are
            written.
    """
    for name, data in files.items():
        (folder / name).write_bytes(data)
    entries = {name: FileEntry(len(data), "0" * 64) for name, data in files.items()}
    return Asset(folder, replace(manifest, files=entries), arrays)
