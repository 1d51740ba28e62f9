"""Limits on the asset's size and loss: what fits, and whether they were met.

How long a frame takes to play on this machine, and the widest head and the most lookups that keep to a
time.

An asset that plays before it is written.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from player.asset.asset import Asset, GridArrays
from player.asset.manifest import FileEntry, Manifest
from player.asset.packing import pack_codes, pack_masks
from player.cameras.camera import Camera
from player.errors import TrainingError
from player.render import Renderer
from vfr_bake.config import BakeConfig
from vfr_bake.presets import BakeChoice

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


SIZE = 800
"""Pixels along each side of the frame that is measured."""
N_FRAMES = 3
"""Frames of which the median counts; one before them warms up."""
WIDTHS = (64, 48, 32, 16)
"""Widths of smaller heads that are tried."""
LOOKUPS = (1, 2, 3, 4, 5, 8, 12, 16, 32)
"""Lookups a ray that are tried."""
RESERVE = 0.9
"""Of the time that is asked for, what a choice may take before refinement."""

Measure = Callable[[int, int], float]
"""Milliseconds of a frame by (head's width, 0 the model's own; lookups a ray, 0 all)."""


def frame_ms(asset: Asset, camera: Camera, n_fetches: int) -> float:
    """Milliseconds of a frame of SIZE x SIZE seen by `camera` (WORLD frame), as the player plays it here."""
    times = []
    with Renderer(asset) as renderer:
        for _ in range(N_FRAMES + 1):
            begin = time.perf_counter()
            renderer.render(camera.resized(SIZE, SIZE), n_fetches)
            times.append(1000 * (time.perf_counter() - begin))
    return float(np.median(times[1:]))


def measured_in_memory(
    manifest: Manifest, arrays: GridArrays, head: Callable[[int], bytes], camera: Camera
) -> Measure:
    """How long an asset that is not written yet would take; `head` gives `head.onnx` by its width."""

    def measure(width: int, n_fetches: int) -> float:
        with tempfile.TemporaryDirectory() as folder:
            asset = unwritten_asset(Path(folder), manifest, arrays, {"head.onnx": head(width)})
            return frame_ms(asset, camera, n_fetches)

    return measure


def keep_to_time(
    choice: BakeChoice, target_ms: float, measure: Measure, same_head: bool, same_lookups: bool
) -> BakeChoice:
    """`choice` with the widest head, and then the most lookups, whose frames take no longer than `target_ms`.

    What was asked for by number, head or lookups, stays the same. Raises TrainingError where the least takes
    longer; it says how long.

    >>> from vfr_bake.presets import PRESETS
    >>> chosen = keep_to_time(PRESETS["balanced"], 100, lambda width, k: width + 6 * k, False, False)
    >>> chosen.head_width, chosen.n_fetches
    (64, 4)
    """
    fewest = choice.n_fetches if same_lookups else min(LOOKUPS)
    least = np.inf
    for width in (choice.head_width,) if same_head else _widths(choice.head_width):
        took = measure(width, fewest)
        least = min(least, took)
        if took > RESERVE * target_ms:
            continue
        for k in (fewest,) if same_lookups else _most_first(choice.n_fetches):
            if k == fewest or measure(width, k) <= RESERVE * target_ms:
                return replace(choice, head_width=width, n_fetches=k)
    raise TrainingError(
        f"bake: time: expected a frame of {SIZE} x {SIZE} in at most {target_ms:g} ms, got {least:.0f} ms "
        "with the fewest lookups and the smallest head: nothing was written: allow more, or lower "
        "--resolution"
    )


def _widths(widest: int) -> Iterator[int]:
    yield widest
    yield from (width for width in WIDTHS if width < widest or not widest)


def _most_first(most: int) -> Iterator[int]:
    yield most
    yield from (k for k in reversed(LOOKUPS) if k < most or not most)


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
