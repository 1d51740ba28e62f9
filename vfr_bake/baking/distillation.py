"""What the player composes on rays, taken apart so that it can be learned, and what the full model shows
there.

Where the player fetches features, and how much each fetch weighs, depends on the densities alone: with the
densities fixed the composite of a ray is a fixed linear map of the stored feature codes,
x = sum_j weights[j] sum_c shares[j, c] codes[rows[j, c]]. A lesson holds that map, by the player's own choice
of samples. Where the densities are learned too, at every sample, it also holds where their codes are.

What rays compose if the stored vertices hold the field's own features, all channels, as they are: what the
grid loses by itself. They are evaluated where the rays meet them, because those of a large grid would take
gigabytes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from player.asset.grid import SparseGrid
from player.asset.vertex_rows import VertexRows
from player.cameras.camera import Camera
from player.errors import TrainingError
from player.march.fetches import MIN_TOTAL, Samples, equal_mass_bins, heaviest
from player.march.march import MIN_OPACITY, MarchResult
from player.march.marches import sampled_rays
from vfr_bake.baking.grids import Layout, unit_points
from vfr_bake.kernels.stored_features import compose, corner_rows
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.model_file import Model

RAYS_AT_ONCE = 1 << 14
SOME = 4096
"""Lessons that tell the size of composites."""


@dataclass(frozen=True, eq=False)
class Fetches:
    """What n rays fetch, as `vfr_bake.kernels.stored_features` takes it."""

    starts: np.ndarray
    """[n + 1] int64: ray i has the fetches starts[i] to starts[i + 1]."""
    rows: np.ndarray
    """[n_fetches, 8] int32 rows of the stored features: the corners around each place."""
    shares: np.ndarray
    """[n_fetches, 8] float32 of the corners, 1 in all, or 0 where too little is stored."""
    density_rows: np.ndarray
    """[n_fetches, 8] int32 rows of the stored densities in the same way; [0, 8] where they do not learn."""
    density_shares: np.ndarray
    """[n_fetches, 8] float32, 0 of what is not stored; [0, 8] where they do not learn."""
    weights: np.ndarray
    """[n_fetches] float32 compositing weights."""
    lengths: np.ndarray
    """[n_fetches] float32 way that a sample stands for, model units."""


@dataclass(frozen=True, eq=False)
class Lessons:
    """n rays that meet something in the baked grid. They keep the places of their fetches, 20 bytes each; the
    corners around them, 128 bytes, are found where a batch needs them."""

    starts: np.ndarray
    """[n + 1] int64: lesson i has the fetches starts[i] to starts[i + 1]."""
    points: np.ndarray
    """[n_fetches, 3] float32 places, cells of the densities' grid."""
    weights: np.ndarray
    """[n_fetches] float32 compositing weights."""
    lengths: np.ndarray
    """[n_fetches] float32 way that a sample stands for, model units."""
    dirs: np.ndarray
    """[n, 3] float32 unit view directions."""
    opacity: np.ndarray
    """[n] float32 of the baked grid."""
    colours: np.ndarray
    """[n, 3] float32: the full model's colours times its opacity."""
    full_opacity: np.ndarray
    """[n] float32 of the full model."""
    features: VertexRows
    feature_scale: np.float32
    """Cells of the features' grid in a cell of the densities'."""
    densities: VertexRows | None
    """Where they learn."""

    def __len__(self) -> int:
        return len(self.opacity)

    def fetches(self, some: np.ndarray) -> Fetches:
        """Those of the lessons whose numbers are in `some`, in that order."""
        counts = self.starts[some + 1] - self.starts[some]
        starts = np.concatenate([[0], np.cumsum(counts)])
        index = np.repeat(self.starts[some] - starts[:-1], counts) + np.arange(starts[-1])
        points = self.points[index]
        of_features = corners(self.features, points * self.feature_scale, MIN_TOTAL)
        none = np.zeros((0, 8), np.int32), np.zeros((0, 8), np.float32)
        of_densities = none if self.densities is None else corners(self.densities, points, np.float32(0))
        return Fetches(starts, *of_features, *of_densities, self.weights[index], self.lengths[index])

    def composed(self, codes: np.ndarray) -> np.ndarray:
        """[n, n_channels] float32 composites of `codes` [n_vertices, n_channels] float32, rounded."""
        out = np.empty((len(self), codes.shape[1]), np.float32)
        for first in range(0, len(self), RAYS_AT_ONCE):
            some = np.arange(first, min(first + RAYS_AT_ONCE, len(self)))
            compose_into(self.fetches(some), codes, out[some[0] : some[-1] + 1])
        return out

    def typical(self, codes: np.ndarray) -> np.ndarray:
        """[n_channels] mean size of the composites of `codes`, of some lessons; never 0."""
        some = np.arange(min(SOME, len(self))) * len(self) // min(SOME, len(self))
        out = np.empty((len(some), codes.shape[1]), np.float32)
        compose_into(self.fetches(some), codes, out)
        return np.maximum(np.abs(out).mean(axis=0), 1e-3)


@dataclass(frozen=True, eq=False)
class Taught:
    """n rays and what the full model shows on them."""

    rays_o: np.ndarray
    """[n, 3] float32, model frame."""
    rays_d: np.ndarray
    """[n, 3] float32, of unit length."""
    features: np.ndarray
    """[n, n_channels] float32 composited features of the model."""
    colours: np.ndarray
    """[n, 3] float32 colours times opacity."""
    opacity: np.ndarray
    """[n] float32."""

    def some(self, n: int) -> Taught:
        """About n of the rays, evenly."""
        return Taught(*(column[:: max(len(self.opacity) // n, 1)] for column in vars(self).values()))


def teach(
    model: Model, cameras: list[Camera], n_rays: int, seed: int, progress: Callable[[int, int], object]
) -> Taught:
    """The full model on about `n_rays` random pixels of `cameras` (model frame); those at which it has
    nothing to show are left out."""
    random = np.random.default_rng(seed)
    parts = []
    for done, camera in enumerate(cameras):
        rays_o, rays_d = camera.rays()
        some = random.choice(len(rays_o), min(len(rays_o), max(n_rays // len(cameras), 1)), replace=False)
        features, opacity, _ = model.sampler.composited_features(model.field, rays_o[some], rays_d[some])
        met = np.flatnonzero(opacity > 0)
        some, features, opacity = some[met], features[met], opacity[met]
        colours = head_colours(model.field, features, rays_d[some]) * opacity[:, None]
        parts.append((rays_o[some], rays_d[some], features, colours, opacity))
        progress(done + 1, len(cameras))
    return Taught(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def collect_lessons(
    taught: Taught, grid: SparseGrid, n_fetches: int, densities: VertexRows | None = None
) -> Lessons:
    """Lessons from those rays that meet something in the grid.

    Args:
        taught: the rays.
        grid: as the player has it.
        n_fetches: the player's k, 0 for every sample.
        densities: rows of the stored densities, at every sample: for densities that learn.

    Raises TrainingError where no ray meets anything.
    """
    parts = []
    for first in range(0, len(taught.opacity), RAYS_AT_ONCE):
        rows = slice(first, first + RAYS_AT_ONCE)
        hits, opacity, fetches = player_fetches(grid, taught.rays_o[rows], taught.rays_d[rows], n_fetches)
        of_hits = (column[rows][hits] for column in (taught.rays_d, taught.colours, taught.opacity))
        dirs, colours, full_opacity = of_hits
        parts.append((*fetches, dirs, opacity, colours, full_opacity))
    if sum(len(part[0]) for part in parts) == 0:
        raise TrainingError("the baked grid shows nothing in any training view: train longer")
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    starts = np.concatenate([[0], np.cumsum(columns[0], dtype=np.int64)])
    return Lessons(
        starts, *columns[1:], features=grid.rows, feature_scale=grid.feature_scale, densities=densities
    )


def player_fetches(
    grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, n_fetches: int
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """Where the player fetches features on the rays that hit, and how much each fetch weighs, as
    `player.march.march` composes them.

    Returns hits [n_hits], their opacity [n_hits], and (fetches of each hit [n_hits], places [n_fetches, 3]
    float32 in cells of the densities' grid, weights [n_fetches], lengths [n_fetches]).
    """
    entries, samples, tau = sampled_rays(grid, rays_o, rays_d)
    opacity = -np.expm1(-tau)
    hits = np.flatnonzero(opacity > MIN_OPACITY)
    is_hit = np.zeros(len(opacity), bool)
    is_hit[hits] = True
    counts = np.bincount(samples.ray, minlength=len(opacity))
    merged = is_hit[samples.ray] & (counts[samples.ray] > n_fetches) & (n_fetches > 0)
    own = Samples(*(column[is_hit[samples.ray] & ~merged] for column in samples))
    ray, s, weights = own
    if merged.any():
        many = Samples(*(column[merged] for column in samples))
        bins = equal_mass_bins(many, n_fetches)
        places = bins.s.copy()
        points = np.ascontiguousarray(entries.at(bins.ray, places).T)
        gaps = np.flatnonzero(~corners(grid.rows, points * grid.feature_scale, MIN_TOTAL)[1].any(axis=1))
        if len(gaps):
            places[gaps] = many.s[heaviest(bins, gaps)]
        ray = np.concatenate([ray, bins.ray])
        s = np.concatenate([s, places])
        weights = np.concatenate([weights, opacity[bins.ray] / np.float32(n_fetches)])
        order = np.argsort(ray, kind="stable")
        ray, s, weights = ray[order], s[order], weights[order]
    counts = np.bincount(ray, minlength=len(opacity))[hits]
    points = np.ascontiguousarray(entries.at(ray, s).T)
    return hits, opacity[hits], (counts, points, weights.astype(np.float32), entries.lengths(ray, s))


def compose_into(fetches: Fetches, codes: np.ndarray, out: np.ndarray) -> None:
    """Composites [n, n_channels] float32 of `codes` [n_vertices, n_channels] float32, rounded, into `out`."""
    compose(fetches.starts, fetches.rows, fetches.shares, fetches.weights, codes, out)


def corners(vertices: VertexRows, points: np.ndarray, least: np.float32) -> tuple[np.ndarray, np.ndarray]:
    """Rows and shares [n, 8] of the corners around `points` [n, 3] float32, cells of the vertices' own grid;
    shares 0 where the stored ones have less than `least` in all."""
    n = len(points)
    rows, shares = np.empty((n, 8), np.int32), np.empty((n, 8), np.float32)
    corner_rows(
        points, vertices.resolution, vertices.n_per_axis, vertices.bricks, vertices.rows, least, rows, shares,
    )  # fmt: skip
    return rows, shares


FIELD_RAYS_AT_ONCE = 1 << 13


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
    for first in range(0, len(features), FIELD_RAYS_AT_ONCE):
        part = slice(first, first + FIELD_RAYS_AT_ONCE)
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
