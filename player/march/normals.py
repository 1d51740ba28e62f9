"""Normals of pixels: gradients of the density, composited like a feature.

Notation: x_i are samples with weights w_i as in `player.march.march`; sigma is the density. A pixel's normal
is `N = normalise(- sum w_i grad log sigma(x_i))`: it points where density falls. The logarithm of the density
is linear in the interpolated code (`player.asset.density`), so that its gradient is proportional to that of
the trilinear code in the sample's cell. In contracted space the gradient is pulled back to the model frame.
Gradients are summed before the sum is normalised: where the code is flat, inside a solid, the gradient is 0
and adds no direction.
"""

from __future__ import annotations

import numpy as np

from player.asset.grid import CELLS_OF_LEVELS, SparseGrid
from player.march.box import Bounds
from player.march.march import sample_rays


def composited_normals(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    bounds: Bounds | None = None,
) -> np.ndarray:
    """Compute normals of rays, in the model frame. The numpy march runs once more to collect the samples.

    Args:
        grid: the sparse grid.
        rays_o: [n, 3] float32 origins, model frame.
        rays_d: [n, 3] float32 unit directions, model frame.
        bounds: as for `player.march.march.march`.

    Returns:
        normals: [n, 3] float32, of unit length; 0 where no sample has weight or the gradients cancel.
    """
    path, samples, *_ = sample_rays(grid, rays_o, rays_d, bounds)
    slopes = code_gradient(grid, path.at(samples.ray, samples.s)) * grid.cells_per_unit[:, None]
    slopes = path.pulled_back(slopes, samples.ray, samples.s)
    weights = samples.weights.astype(np.float64)
    normals = np.stack([-np.bincount(samples.ray, weights * slope, len(rays_o)) for slope in slopes], axis=-1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(length > 1e-9, normals / np.where(length > 1e-9, length, 1), 0).astype(np.float32)


def code_gradient(grid: SparseGrid, g: np.ndarray) -> np.ndarray:
    """Return the gradient [3, n] float32 of the interpolated density code, in codes per cell; 0 outside of
    live cells.

    `g` [3, n] float32: grid coordinates (cells). Samples of the march lie in live cells, but in contracted
    space their coordinates are computed anew here, and rounding may move them beyond the faces.
    """
    found = grid.find(g)
    at = found.corners
    share = [(1 - side, side) for side in found.fractions]
    slopes = np.zeros((3, g.shape[1]), np.float32)
    for x, y, z in np.ndindex(2, 2, 2):
        code = grid.density.take(at + (x * 81 + y * 9 + z)).astype(np.float32)
        slopes[0] += (2 * x - 1) * code * share[1][y] * share[2][z]
        slopes[1] += (2 * y - 1) * code * share[0][x] * share[2][z]
        slopes[2] += (2 * z - 1) * code * share[0][x] * share[1][y]
    return np.where(found.live, slopes * CELLS_OF_LEVELS.take(found.entries & 7), np.float32(0))
