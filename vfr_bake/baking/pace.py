"""How long a frame takes to play on this machine, and the widest head and the most lookups that keep to a
time."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from player.asset.asset import Asset, GridArrays
from player.asset.manifest import Manifest
from player.cameras.camera import Camera
from player.errors import TrainingError
from player.render import Renderer
from vfr_bake.baking.presets import BakeChoice
from vfr_bake.baking.unwritten import unwritten_asset

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

    >>> from vfr_bake.baking.presets import PRESETS
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
