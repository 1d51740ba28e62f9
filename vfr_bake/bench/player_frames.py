"""The process that plays one asset for the bench: imports the player alone, as `vfr-play` does.

    python -m vfr_bake.bench.player_frames ASSET CAMERAS THREADS MAX_MEMORY

Request: `view`, `size` [width, height], `samples`, and `rgb`, a file for the picture or null. Answer:
milliseconds of the frame and, of them, of march with lookups and of the head (time in their tasks over the
number of threads), fetches a ray that hits, peak memory.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from player.app.play import peak_rss_mb
from player.asset.asset import Asset
from player.cameras.transforms import read_cameras
from player.march.march import MIN_OPACITY
from player.render import Renderer
from vfr_bake.bench.process import Answer, Clock, serve


def open_player(folder: str, cameras: str, threads: str, max_memory: str) -> Answer:
    """An asset ready to play; `threads` 0 is one for each core, `max_memory` 0 a share of the machine's."""
    views = read_cameras(Path(cameras))
    renderer = Renderer(Asset.open(folder, max_memory=float(max_memory) or None), int(threads) or None)
    march, head = (Clock(part) for part in (renderer._module.march, renderer._head))
    renderer._module, renderer._head = SimpleNamespace(march=march), head  # type: ignore[assignment]

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        camera = views[request["view"]].resized(*request["size"])
        march.seconds = head.seconds = 0.0
        start = time.perf_counter()
        frame = renderer.render(camera, request["samples"])
        passed = time.perf_counter() - start
        if request["rgb"] is not None:
            np.save(request["rgb"], frame.rgb)
        taken = frame.n_density_samples[frame.opacity > MIN_OPACITY]
        fetches = np.minimum(taken, request["samples"] or taken)
        return {
            "ms": 1000 * passed,
            "march_ms": 1000 * march.seconds / renderer.n_threads,
            "head_ms": 1000 * head.seconds / renderer.n_threads,
            "fetches": int(fetches.sum()),
            "samples": float(taken.mean()) if len(taken) else 0.0,
            "peak_mb": peak_rss_mb(),
            "march": renderer.march,
            "threads": renderer.n_threads,
        }

    return answer


if __name__ == "__main__":
    serve(lambda: open_player(*sys.argv[1:5]), sys.stdin, sys.stdout)
