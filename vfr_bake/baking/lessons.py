"""What the player composes on rays, taken apart so that it can be learned, and what the full model shows
there.

Where the player fetches features, and how much each fetch weighs, depends on the densities alone: with the
densities fixed the composite of a ray is a fixed linear map of the stored feature codes,
x = sum_j weights[j] sum_c shares[j, c] codes[rows[j, c]]. A lesson holds that map, by the player's own choice
of samples. Where the densities are learned too, at every sample, it also holds where their codes are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from player.cameras import Camera
from player.errors import TrainingError
from player.few_samples import MIN_TOTAL, Places, Samples, equal_mass_bins, heaviest
from player.march import MIN_OPACITY
from player.marches import sampled_rays
from player.sparse_grid import SparseGrid
from player.vertex_rows import ABSENT, VertexRows
from vfr_bake.kernels.stored_features import compose, corner_rows
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.model_file import Model

RAYS_AT_ONCE = 1 << 14
SOME = 4096
"""Lessons that tell the size of composites."""


@dataclass(frozen=True, eq=False)
class Lessons:
    """n rays that meet something in the baked grid."""

    starts: np.ndarray
    """[n + 1] int64: lesson i has the fetches starts[i] to starts[i + 1]."""
    rows: np.ndarray
    """[n_fetches, 8] int32 rows of the stored arrays: the corners around each place."""
    shares: np.ndarray
    """[n_fetches, 8] float32 of the corners, 1 in all."""
    density_rows: np.ndarray
    """[n_fetches, 8] int32 rows of the stored densities in the same way; [0, 8] where they do not learn."""
    density_shares: np.ndarray
    """[n_fetches, 8] float32, or [0, 8]."""
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

    def __len__(self) -> int:
        return len(self.opacity)

    def composed(self, codes: np.ndarray, some: np.ndarray | None = None, rounded: bool = True) -> np.ndarray:
        """[n, n_channels] float32 composites of `codes` [n_vertices, n_channels] float32, of all lessons or
        of those whose numbers are in `some`."""
        some = np.arange(len(self)) if some is None else some
        out = np.empty((len(some), codes.shape[1]), np.float32)
        compose(some, self.starts, self.rows, self.shares, self.weights, codes, rounded, out)
        return out

    def typical(self, codes: np.ndarray) -> np.ndarray:
        """[n_channels] mean size of the composites of `codes`, of some lessons; never 0."""
        some = np.arange(min(SOME, len(self))) * len(self) // min(SOME, len(self))
        return np.maximum(np.abs(self.composed(codes, some)).mean(axis=0), 1e-3)


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
    taught: Taught, grid: SparseGrid, n_samples: int, densities: VertexRows | None = None
) -> Lessons:
    """Lessons from those rays that meet something in the grid.

    Args:
        taught: the rays.
        grid: as the player has it.
        n_samples: the player's k, 0 for every sample.
        densities: rows of the stored densities, at every sample: for densities that learn.

    Raises TrainingError where no ray meets anything.
    """
    parts = []
    for first in range(0, len(taught.opacity), RAYS_AT_ONCE):
        rows = slice(first, first + RAYS_AT_ONCE)
        rays = taught.rays_o[rows], taught.rays_d[rows]
        hits, opacity, fetches = player_fetches(grid, *rays, n_samples, densities)
        of_hits = (column[rows][hits] for column in (taught.rays_d, taught.colours, taught.opacity))
        dirs, colours, full_opacity = of_hits
        parts.append((*fetches, dirs, opacity, colours, full_opacity))
    if sum(len(part[0]) for part in parts) == 0:
        raise TrainingError("the baked grid shows nothing in any training view: train longer")
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Lessons(np.concatenate([[0], np.cumsum(columns[0], dtype=np.int64)]), *columns[1:])


def player_fetches(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    n_samples: int,
    densities: VertexRows | None = None,
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """The linear map from stored codes to the composites of the rays that hit, as `player.march` composes
    them.

    Returns hits [n_hits], their opacity [n_hits], and (fetches of each hit [n_hits], rows [n_fetches, 8],
    shares [n_fetches, 8], rows and shares of the densities, weights [n_fetches], lengths [n_fetches]); of
    the densities there are none without `densities`.
    """
    entries, samples, tau = sampled_rays(grid, rays_o, rays_d)
    opacity = -np.expm1(-tau)
    hits = np.flatnonzero(opacity > MIN_OPACITY)
    is_hit = np.zeros(len(opacity), bool)
    is_hit[hits] = True
    counts = np.bincount(samples.ray, minlength=len(opacity))
    merged = is_hit[samples.ray] & (counts[samples.ray] > n_samples) & (n_samples > 0)
    own = Samples(*(column[is_hit[samples.ray] & ~merged] for column in samples))
    ray, s, weights = own
    if merged.any():
        many = Samples(*(column[merged] for column in samples))
        bins = equal_mass_bins(many, n_samples)
        places = bins.s.copy()
        gaps = np.flatnonzero(_feature_corners(grid, entries, bins.ray, places)[1].sum(axis=1) < MIN_TOTAL)
        if len(gaps):
            places[gaps] = many.s[heaviest(bins, gaps)]
        ray = np.concatenate([ray, bins.ray])
        s = np.concatenate([s, places])
        weights = np.concatenate([weights, opacity[bins.ray] / np.float32(n_samples)])
        order = np.argsort(ray, kind="stable")
        ray, s, weights = ray[order], s[order], weights[order]
    rows, shares = _feature_corners(grid, entries, ray, s)
    total = shares.sum(axis=1)
    stored = total >= MIN_TOTAL
    shares /= np.where(stored, total, 1)[:, None]
    weights = np.where(stored, weights, np.float32(0)).astype(np.float32)
    counts = np.bincount(ray, minlength=len(opacity))[hits]
    none = np.zeros((0, 8), np.int32), np.zeros((0, 8), np.float32)
    of_densities = none if densities is None else _corners(densities, entries.at(ray, s))
    lengths = entries.lengths(ray, s)
    return hits, opacity[hits], (counts, rows, shares, *of_densities, weights, lengths)


def _feature_corners(
    grid: SparseGrid, entries: Places, ray: np.ndarray, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    return _corners(grid.rows, entries.at(ray, s) * grid.feature_scale)


def _corners(vertices: VertexRows, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and shares [n, 8] of the corners around `points` [3, n], cells of the vertices' own grid."""
    n = points.shape[1]
    rows, shares = np.empty((n, 8), np.int32), np.empty((n, 8), np.float32)
    corner_rows(
        np.ascontiguousarray(points, np.float32), vertices.resolution, vertices.n_per_axis, vertices.bricks,
        vertices.base, vertices.ranks, ABSENT, rows, shares,
    )  # fmt: skip
    return rows, shares
