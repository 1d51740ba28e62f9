"""Which cells of the grid any training view sees: only those are stored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vfr_bake.baking.views import views_between
from vfr_bake.kernels.march import mark_visible_cells
from vfr_bake.rendering.samples import LIMITS
from vfr_bake.training.model_file import Model

HITS = 8
"""Rays that meet a surface cell over all views, on average; the cells that still escape are gaps to be
closed."""
VIEWS_OF_A_CELL = 0.4
"""Share of the training views that see a given piece of surface, roughly."""

Progress = Callable[[int, int], object]
"""Called with (done, of)."""


def marked_cells(
    model: Model, resolution: int, weight_floors: tuple[float, ...], progress: Progress
) -> np.ndarray:
    """[resolution, resolution, resolution, n_floors] uint8, 1 for cells in which a sample of some view's ray
    weighs at least each floor. Views are the training cameras and as many between them.

    Rays leave each camera as densely as it takes for every surface cell to be met HITS times over
    all views, whatever the pictures' size.
    """
    marks = np.zeros((*(resolution,) * 3, len(weight_floors)), np.uint8)
    cameras = model.model_cameras()
    cameras += views_between(model, len(cameras), seed=0)
    density = _ray_density(np.tile(pixel_footprints(model), 2), 2 / resolution)
    # No cell between two samples may be missed: other rays than these will be played.
    step = min(model.occupancy.step, 2 / resolution)
    for index, camera in enumerate(cameras):
        size = (max(1, round(camera.width * density)), max(1, round(camera.height * density)))
        rays_o, rays_d = camera.resized(*size).rays()
        mark_visible_cells(
            rays_o, rays_d, np.float32(step), model.occupancy.distance,
            *model.field.kernel_arguments(), LIMITS, np.array(weight_floors, np.float32), marks,
        )  # fmt: skip
        progress(index + 1, len(cameras))
    return marks


def occupied_cells(model: Model, resolution: int) -> np.ndarray:
    """[resolution]^3 bool: cells in some part of which the training's occupancy grid allows matter."""
    cells = model.occupancy.occupied
    n = len(cells)
    first = np.arange(resolution) * n // resolution
    last = (np.arange(1, resolution + 1) * n - 1) // resolution
    for axis in range(3):
        parts = [cells.take(np.minimum(first + i, last), axis) for i in range(max(last - first) + 1)]
        cells = np.logical_or.reduce(parts)
    return cells


def pixel_footprints(model: Model) -> np.ndarray:
    """[n_views] size of each training camera's pixels at the middle of the box, model units."""
    cameras = model.model_cameras()
    return np.array([max(float(np.linalg.norm(c.c2w[:3, 3])), 1e-6) / c.fx for c in cameras])


def rays_of_views(model: Model, resolution: int) -> float:
    """Rays that `marked_cells` sends out."""
    density = _ray_density(np.tile(pixel_footprints(model), 2), 2 / resolution)
    return 2 * density**2 * sum(camera.width * camera.height for camera in model.cameras)


def _ray_density(footprints: np.ndarray, cell: float) -> float:
    """Rays per pixel along each axis that let HITS rays meet each surface cell at the middle of the box."""
    hits = VIEWS_OF_A_CELL * float(np.sum((cell / footprints) ** 2))
    return float(np.clip(np.sqrt(HITS / hits), 0.25, 4.0))


def close_gaps(cells: np.ndarray) -> np.ndarray:
    """Morphological closing of [n, n, n] bool with a cube of 3 cells: holes and cracks of one cell are
    filled.

    >>> row = np.zeros((5, 5, 5), bool)
    >>> row[1:4, 1:4, 1:4] = True
    >>> row[2, 2, 2] = False
    >>> bool(close_gaps(row)[2, 2, 2]), int(close_gaps(row).sum())
    (True, 27)
    """
    padded = np.pad(cells, 1)
    for axis in range(3):
        padded = _any_of_three(padded, axis)
    for axis in range(3):
        padded = ~_any_of_three(~padded, axis)
    # Outside the box nothing is known to be empty or full: what was marked stays.
    return padded[1:-1, 1:-1, 1:-1] | cells


def _any_of_three(cells: np.ndarray, axis: int) -> np.ndarray:
    """Each cell or either neighbour along an axis."""
    out = cells.copy()
    lower, upper = [slice(None)] * 3, [slice(None)] * 3
    lower[axis], upper[axis] = slice(None, -1), slice(1, None)
    out[tuple(lower)] |= cells[tuple(upper)]
    out[tuple(upper)] |= cells[tuple(lower)]
    return out


def corners_of(cells: np.ndarray) -> np.ndarray:
    """[n + 1, n + 1, n + 1] bool: the corners of the marked cells [n, n, n] bool.

    >>> int(corners_of(np.ones((1, 1, 1), bool)).sum())
    8
    """
    corners = cells
    for axis in range(3):
        shape = list(corners.shape)
        shape[axis] += 1
        grown = np.zeros(shape, bool)
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        grown[tuple(low)] |= corners
        grown[tuple(high)] |= corners
        corners = grown
    return corners


def subdivided(cells: np.ndarray, resolution: int, planes: slice = slice(None)) -> np.ndarray:
    """[n_planes, resolution, resolution] bool: cells of a grid of `resolution` over the same box whose middle
    is in one of `cells` [n, n, n] bool, in some of its planes along x.

    >>> subdivided(np.array([True, False]).reshape(2, 1, 1).repeat(2, 1).repeat(2, 2), 5)[:, 0, 0].tolist()
    [True, True, False, False, False]
    """
    which = (2 * np.arange(resolution) + 1) * len(cells) // (2 * resolution)
    return cells[np.ix_(which[planes], which, which)]
