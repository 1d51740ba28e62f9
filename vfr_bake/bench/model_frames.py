"""The process that renders the full model for the bench.

    python -m vfr_bake.bench.model_frames MODEL CAMERAS THREADS

Requests and answers are those of `vfr_bake.bench.player_frames`; a model has no `samples`.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from player.app.play import peak_rss_mb
from player.cameras.transforms import read_cameras
from vfr_bake.bench.process import Answer, serve


def open_model(path: str, cameras: str, threads: str) -> Answer:
    """A model ready to render; `threads` 0 is one for each core."""
    import numba
    import torch

    from vfr_bake.rendering.render import render_image
    from vfr_bake.training.model_file import load_model

    if int(threads):
        torch.set_num_threads(int(threads))
        numba.set_num_threads(min(int(threads), numba.get_num_threads()))
    model = load_model(Path(path))
    views = [c.transformed(np.linalg.inv(model.world_from_model)) for c in read_cameras(Path(cameras))]

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        camera = views[request["view"]].resized(*request["size"])
        start = time.perf_counter()
        rgb = render_image(model.field, model.sampler, camera, model.background)
        passed = time.perf_counter() - start
        if request["rgb"] is not None:
            np.save(request["rgb"], rgb)
        whole = {"march_ms": 0.0, "head_ms": 0.0, "fetches": 0}  # a model's frame is not taken apart
        return whole | {"ms": 1000 * passed, "peak_mb": peak_rss_mb()}

    return answer


if __name__ == "__main__":
    serve(lambda: open_model(*sys.argv[1:4]), sys.stdin, sys.stdout)
