"""What rays compose if the stored vertices hold the field's own features, all channels, as they are: what the
grid loses by itself. They are evaluated where the rays meet them, because those of a large grid would take
gigabytes."""

from __future__ import annotations

import numpy as np

from player.asset.grid import SparseGrid
from player.march.fetches import MIN_TOTAL
from player.march.march import MarchResult
from vfr_bake.baking.grids import Layout, unit_points
from vfr_bake.baking.lessons import corners, player_fetches
from vfr_bake.training.model_file import Model

RAYS_AT_ONCE = 1 << 13


def with_field_features(
    model: Model,
    layout: Layout,
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    played: MarchResult,
) -> MarchResult:
    """`played`, the march of the rays [n, 3] through `grid` at every sample, with the model's features."""
    features = np.zeros((len(played.hits), model.field.config.n_channels), np.float32)
    for first in range(0, len(features), RAYS_AT_ONCE):
        part = slice(first, first + RAYS_AT_ONCE)
        rays = played.hits[part]
        met, _, fetches = player_fetches(grid, rays_o[rays], rays_d[rays], 0)
        features[first + met] = _composed(model, layout, grid, *fetches[:3])
    return played._replace(features=features)


def _composed(
    model: Model,
    layout: Layout,
    grid: SparseGrid,
    counts: np.ndarray,
    points: np.ndarray,
    weights: np.ndarray,
) -> np.ndarray:
    """[n, n_channels] of rays with `counts` [n] fetches at `points` [n_fetches, 3]. The kernel that composes
    what is stored rounds it; these are no codes."""
    rows, shares = corners(grid.rows, points * grid.feature_scale, MIN_TOTAL)
    met, where = np.unique(rows, return_inverse=True)
    at = unit_points(layout.features.index[met], layout.features.resolution, layout.contracted)
    vertices = model.field.features(at)
    fetched = np.zeros((len(points), vertices.shape[1]), np.float32)
    for corner, share in zip(where.reshape(rows.shape).T, shares.T, strict=True):
        fetched += share[:, None] * vertices[corner]
    fetched *= weights[:, None]
    return np.add.reduceat(fetched, np.cumsum(counts) - counts)
