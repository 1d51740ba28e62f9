"""Processes that render for the bench: one plays an asset, another renders the full model.

    python -m vfr_bake.bench.frames player ASSET CAMERAS THREADS MAX_MEMORY
    python -m vfr_bake.bench.frames model MODEL CAMERAS THREADS MAX_MEMORY

A request has `view`, `size` [width, height], for an asset `samples` and `quality`, and `rgb`: a file for the
picture [height, width, 4], its colours over the background and its opacity, or null. The answer has the
milliseconds of the frame, and the parts that the march with lookups and the head take (time in their tasks
over the number of threads), the feature lookups of all rays that hit, and the peak memory. A model's frame
is not split into parts.

The player's process imports the player alone, as `vfr-play` does. So the imports that only one of the
processes needs are inside the function that opens its asset or model.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from player.app.play import peak_rss_mb
from player.cameras.transforms import read_cameras
from vfr_bake.bench.process import Answer, Clock, serve


def open_player(folder: str, cameras: str, threads: str, max_memory: str) -> Answer:
    """Open an asset and return a function that plays it; `threads` 0 is one for each core, `max_memory` 0 a
    share of the machine's memory."""
    from player.asset.asset import Asset
    from player.march.march import MIN_OPACITY
    from player.render import Renderer, fetches_used

    views = read_cameras(Path(cameras))
    asset = Asset.open(folder, max_memory=float(max_memory) or None)
    renderer = Renderer(asset, int(threads) or None)
    march, head = (Clock(part) for part in (renderer._module.march, renderer._head))
    renderer._module, renderer._head = SimpleNamespace(march=march), head  # type: ignore[assignment]

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        camera = views[request["view"]].resized(*request["size"])
        march.seconds = head.seconds = 0.0
        frame, ms = _timed(lambda: renderer.render(camera, request["samples"], quality=request["quality"]))
        k = fetches_used(asset, request["samples"], request["quality"])
        taken = frame.n_density_samples[(frame.opacity > MIN_OPACITY) & (frame.n_density_samples > 0)]
        return _kept(request, frame.rgb, frame.opacity) | {
            "ms": ms,
            "march_ms": 1000 * march.seconds / renderer.n_threads,
            "head_ms": 1000 * head.seconds / renderer.n_threads,
            "fetches": int(np.minimum(taken, k or taken).sum()),
            "samples": float(taken.mean()) if len(taken) else 0.0,
            "march": renderer.march,
            "threads": renderer.n_threads,
        }

    return answer


def open_model(path: str, cameras: str, threads: str, max_memory: str) -> Answer:
    """Open a model and return a function that renders it; `threads` and `max_memory` are those of
    `open_player`."""
    import numba
    import torch

    from vfr_bake.rendering.render import render_camera
    from vfr_bake.training.model_file import load_model

    if int(threads):
        torch.set_num_threads(int(threads))
        numba.set_num_threads(min(int(threads), numba.get_num_threads()))
    model = load_model(Path(path), float(max_memory) or None)
    views = [c.transformed(np.linalg.inv(model.world_from_model)) for c in read_cameras(Path(cameras))]

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        camera = views[request["view"]].resized(*request["size"])
        (colours, opacity), ms = _timed(lambda: render_camera(model.field, model.sampler, camera))
        rgb = colours + (1 - opacity[:, None]) * model.background
        size = camera.height, camera.width
        return _kept(request, rgb.reshape(*size, 3), opacity.reshape(size)) | {
            "ms": ms,
            "march_ms": 0.0,
            "head_ms": 0.0,
            "fetches": 0,
        }

    return answer


def _timed(render: Callable[[], Any]) -> tuple[Any, float]:
    """Return what `render` returns, and the milliseconds that it took."""
    start = time.perf_counter()
    rendered = render()
    return rendered, 1000 * (time.perf_counter() - start)


def _kept(request: dict[str, Any], rgb: np.ndarray, opacity: np.ndarray) -> dict[str, Any]:
    """Write the picture if the request asks for it; return the peak memory."""
    if request["rgb"] is not None:
        np.save(request["rgb"], np.concatenate([rgb, opacity[..., None]], axis=-1))
    return {"peak_mb": peak_rss_mb()}


if __name__ == "__main__":
    opened = {"player": open_player, "model": open_model}[sys.argv[1]]
    serve(lambda: opened(*sys.argv[2:]), sys.stdin, sys.stdout)
