"""The limits of a bake on size, loss and frame time: choose what fits them, and check whether they were met.

The frame time is measured with the player on this machine, on an asset that is not written yet.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from player.asset.asset import Asset, GridArrays
from player.asset.manifest import Manifest, file_entry
from player.cameras.camera import Camera
from player.errors import FormatError, TrainingError
from player.page.gpu_memory import gpu_bytes
from player.render import Renderer
from vfr_bake.config import BakeConfig
from vfr_bake.presets import PAGE_MB, BakeChoice, Preset
from vfr_bake.training.length.witness_loss import Loss

MANIFEST_BYTES = 25_000
"""Bytes reserved for the manifest if the asset has to fit into a number of bytes."""
CELL_BYTES = 0.1
"""Least bytes for a stored feature cell with its densities: with fewer bytes per cell, coarser grids look
better."""
PAGE_CHANNEL_BYTES, PAGE_COLUMN_BYTES, PAGE_DENSITY_BYTES = 1.4, 5, 13
"""Rough bytes of graphics memory that a page takes for each feature cell: per channel (above 1, because there
are more vertices than cells), for the index that finds the vertices, and per density."""
FEWEST_CELLS = 4096
"""Fewest cells of an asset: with fewer it shows nothing."""
SIZE = 800
"""Pixels along each side of the measured frame."""
N_FRAMES = 3
"""Measured frames, of which the median is taken; one more frame before them warms up."""
WIDTHS = (64, 48, 32, 16)
"""Widths of smaller heads that are tried."""
LOOKUPS = (1, 2, 3, 4, 5, 8, 12, 16, 32)
"""Numbers of feature lookups a ray that are tried."""
RESERVE = 0.9
"""Share of the allowed frame time that may be taken before refinement."""

Measure = Callable[[int, int], float]
"""A function that measures the milliseconds of a frame from (width of the head, 0 for the model's own;
feature lookups a ray, 0 for every sample)."""


def cells_that_fit(max_mb: float, others: int) -> int:
    """Return how many feature cells may be stored in `max_mb` megabytes, of which MANIFEST_BYTES and `others`
    bytes are taken by other data.

    >>> cells_that_fit(3.0, 300_000)
    26750000
    """
    return max(int((max_mb * 1e6 - others - MANIFEST_BYTES) / CELL_BYTES), FEWEST_CELLS)


def cells_of_page(page_mb: float, n_channels: int, densities_per_cell: float) -> int:
    """Estimate how many feature cells may be stored if a page of the asset is to take at most `page_mb`
    megabytes of graphics memory.

    >>> cells_of_page(512, 24, 1.0)
    9922480
    """
    of_features = PAGE_CHANNEL_BYTES * 4 * -(-n_channels // 4) + PAGE_COLUMN_BYTES
    return max(int(page_mb * 1e6 / (of_features + PAGE_DENSITY_BYTES * densities_per_cell)), FEWEST_CELLS)


def file_sizes(folder: Path) -> dict[str, int]:
    """Return the bytes of each of the asset's files, by name; the report is not included."""
    paths = sorted(path for path in folder.iterdir() if path.stem != "report")
    return {path.name: path.stat().st_size for path in paths}


def page_memory(asset: Asset, preset: Preset) -> tuple[int | None, list[str]]:
    """Return the bytes of graphics memory that a page of the asset takes, None if there can be no page of it;
    and in words what was missed if that is more than the preset should take."""
    try:
        n_bytes = gpu_bytes(asset)
    except FormatError as error:
        return None, [f"page: {error}: lower --resolution to make pages"]
    if n_bytes <= 1e6 * PAGE_MB[preset]:
        return n_bytes, []
    megabytes = -(-n_bytes // 10**6)
    return n_bytes, [
        f"preset {preset}: expected a page that takes at most {PAGE_MB[preset]} MB of graphics memory, got "
        f"{megabytes} MB: lower --resolution, or export with --max-gpu-mb {megabytes}"
    ]


class LossMissedError(TrainingError):
    """A bake loses more than is allowed."""


def check_budget(config: BakeConfig, loss: Loss, megabytes: float, ms: float | None) -> None:
    """Raise TrainingError, or LossMissedError, if the written files miss a limit; the message says what they
    reach. `ms` is the frame time, or None if it was not limited. A loss that is only expected, not measured,
    misses none."""
    limits = (
        ("loss", config.max_loss_db, None if loss.spread is None else loss.db, "dB"),
        ("size", config.max_mb, megabytes, "MB"),
        ("time", config.target_ms, ms, "ms"),
    )
    for name, limit, got, unit in limits:
        if limit is not None and got is not None and got > limit:
            error = LossMissedError if name == "loss" else TrainingError
            raise error(
                f"bake: {name}: expected at most {limit:g} {unit}, got {_beyond(limit, got)} {unit} "
                f"({loss.db:.2f} dB in {megabytes:.1f} MB): nothing was written: allow more, or change the "
                "preset"
            )


def _beyond(limit: float, got: float) -> str:
    """Return a number above a limit with two decimals, or with as many as show that it is above.

    >>> _beyond(11.0, 12.345), _beyond(0.05, 0.0503)
    ('12.35', '0.0503')
    """
    decimals = 2
    while float(shown := f"{got:.{decimals}f}") <= limit:
        decimals += 1
    return shown


def frame_ms(asset: Asset, camera: Camera, n_fetches: int) -> float:
    """Measure the milliseconds that the player takes on this machine for a frame of SIZE x SIZE seen by
    `camera` (WORLD frame)."""
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
    """Return `choice` with the widest head, and then the most feature lookups, whose frames take at most
    RESERVE times `target_ms`.

    With `same_head` or `same_lookups`, the head or the number of lookups stays, because it was given. Raises
    TrainingError if even the fastest choice takes longer; the message says how long.

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
    """Return `most`, followed by those of `tried`, which are in falling order, that are less than `most`. A
    `most` of 0 counts as more than any number."""
    return [most, *(n for n in tried if n < most or not most)]


def unwritten_asset(folder: Path, manifest: Manifest, arrays: GridArrays, files: dict[str, bytes]) -> Asset:
    """Return an asset made of `manifest` and `arrays`, which stay in memory.

    Args:
        folder: an empty folder; it must exist as long as the asset is used.
        files: contents by name of the files that are opened by their path: `{"head.onnx": ...,
            "cameras.json": ...}`; only these are written.
    """
    for name, data in files.items():
        (folder / name).write_bytes(data)
    entries = {name: file_entry(data) for name, data in files.items()}
    return Asset(folder, replace(manifest, files=entries), arrays)
