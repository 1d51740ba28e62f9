"""Which cells of the grid any training view sees: only those are stored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from player.cameras import Camera
from player.errors import TrainingError
from vfr_bake.kernels.march import mark_visible_cells
from vfr_bake.rendering.sampling import LIMITS
from vfr_bake.training.model_file import Model

Progress = Callable[[int, int], object]
"""Called with (done, of)."""


def visible_cells(model: Model, resolution: int, weight_floor: float, progress: Progress) -> np.ndarray:
    """[resolution]^3 bool: cells in which a sample of some training ray weighs at least `weight_floor`.

    Every pixel of every training camera sends a ray through the full model. Raises TrainingError when
    nothing is seen.
    """
    visible = np.zeros((resolution,) * 3, np.uint8)
    cameras = model.model_cameras()
    # No cell between two samples may be missed: other rays than these will be played.
    step = min(model.occupancy.step, 2 / resolution)
    for index, camera in enumerate(cameras):
        rays_o, rays_d = _half_of_the_rays(camera, odd=index % 2 == 1)
        mark_visible_cells(
            rays_o, rays_d, np.float32(step), model.occupancy.distance,
            *model.field.kernel_arguments(), LIMITS, np.float32(weight_floor), visible,
        )  # fmt: skip
        progress(index + 1, len(cameras))
    if not visible.any():
        raise TrainingError(
            f"no cell weighs {weight_floor} in any training view: the model is empty or a thin fog: "
            "train longer, or lower --weight-floor"
        )
    return visible.view(bool)


def _half_of_the_rays(camera: Camera, odd: bool) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.divmod(np.arange(camera.width * camera.height), camera.width)
    chosen = (rows + columns) % 2 == odd
    rays_o, rays_d = camera.rays()
    return rays_o[chosen], rays_d[chosen]


def corner_vertices(cells: np.ndarray) -> np.ndarray:
    """Grid indices [n_vertices, 3] of all corners of the marked cells [n, n, n] bool.

    >>> corner_vertices(np.ones((1, 1, 1), bool)).shape
    (8, 3)
    """
    stored = np.zeros(tuple(n + 1 for n in cells.shape), bool)
    for corner in range(8):
        x, y, z = corner & 1, corner >> 1 & 1, corner >> 2 & 1
        n, m, k = cells.shape
        stored[x : x + n, y : y + m, z : z + k] |= cells
    return np.argwhere(stored)
