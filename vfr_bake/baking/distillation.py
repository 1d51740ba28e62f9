"""Training data of the refinement: what the full model and photographs show on rays, and what the player
composes there, taken apart so that it can be trained.

Where the player fetches features, and how much each fetch weighs, depends on the densities alone: with the
densities fixed the composite of a ray is a fixed linear map of the stored feature codes,
x = sum_j weights[j] sum_c shares[j, c] codes[rows[j, c]]. The fetches of training rays hold that map, by
the player's own choice of samples. Where the densities are trained too, at every sample, they also hold where
their codes are.

With the field's own features in place of the stored codes, the same map tells what the grid loses by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import get_num_threads

from player.asset.grid import SparseGrid, VertexRows
from player.cameras.camera import Camera
from player.compiled.samples import sample_rays
from player.errors import TrainingError
from player.march.fetches import MIN_TOTAL, Samples, equal_mass_bins, heaviest
from player.march.march import MIN_OPACITY, MarchResult
from player.march.path import path_of
from vfr_bake.baking.cells import Progress
from vfr_bake.baking.grids import Layout, unit_points
from vfr_bake.kernels.stored_features import compose, composite, corner_rows, interpolate, padded, take_runs
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.model_file import Model

RAYS_AT_ONCE = 1 << 12
"""Few, because a ray through fog has hundreds of samples, of 100 to 200 bytes each meanwhile."""
FIELD_RAYS_AT_ONCE = 1 << 13
"""Rays on which the field is evaluated at once."""
MOST_KEPT = 20_000_000
"""Samples of training rays that are kept at most: 320 MB. Memory is taken for those alone that there are."""
N_TYPICAL = 4096
"""Training rays that tell the typical size of composites."""


class Corners(NamedTuple):
    """The stored vertices around n places, each with its share in what is interpolated there."""

    rows: np.ndarray
    """[n, 8] int32 rows of the stored vertices."""
    shares: np.ndarray
    """[n, 8] float32."""


class Fetches(NamedTuple):
    """What n rays fetch, as `vfr_bake.kernels.stored_features` takes it."""

    starts: np.ndarray
    """[n + 1] int64: ray i has the fetches starts[i] to starts[i + 1]."""
    features: Corners
    """The stored features around each fetch; shares are 1 in all, or 0 where too little is stored."""
    densities: Corners
    """The stored densities around each fetch; shares are 0 where none is stored. Empty, [0, 8], where
    densities are not trained."""
    weights: np.ndarray
    """[n_fetches] float32 compositing weights."""
    lengths: np.ndarray
    """[n_fetches] float32 length of the ray that a sample stands for, model units; 0 for what several samples
    were merged into."""
    opacity: np.ndarray
    """[n] float32 opacity of the baked grid."""

    def compose(self, features: np.ndarray) -> np.ndarray:
        """[n, n_channels] float32 composites of latent features [n_vertices, n_channels] int16, rounded to
        codes."""
        out = np.empty((len(self.opacity), features.shape[1]), np.float32)
        compose(self.starts, *self.features, self.weights, features, out)
        return out

    def interpolate(self, features: np.ndarray) -> np.ndarray:
        """[n_fetches, `padded(n_channels)`] float32: latent features at each fetch, rounded to codes."""
        out = np.empty((len(self.weights), padded(features.shape[1])), np.float32)
        interpolate(*self.features, self.weights, features, out)
        return out

    def composite(self, values: np.ndarray, n_channels: int) -> np.ndarray:
        """[n, n_channels] float32 composites of what `interpolate` gives."""
        out = np.empty((len(self.opacity), n_channels), np.float32)
        composite(self.starts, self.weights, values, out)
        return out


@dataclass(frozen=True, eq=False)
class TeacherRays:
    """n rays and what is to be shown on them: what the full model shows there, alone or in the mean with a
    photograph."""

    rays_o: np.ndarray
    """[n, 3] float32, model frame."""
    rays_d: np.ndarray
    """[n, 3] float32, of unit length."""
    colours: np.ndarray
    """[n, 3] float32 colours times opacity."""
    opacity: np.ndarray
    """[n] float32 opacity."""

    def some(self, n: int) -> TeacherRays:
        """n of the rays, spread evenly; all where there are no more."""
        n_all = len(self.opacity)
        if n >= n_all:
            return self
        return self.chosen(np.arange(n) * n_all // n)

    def chosen(self, rays: np.ndarray | slice) -> TeacherRays:
        """The rays with these numbers."""
        return TeacherRays(*(column[rays] for column in vars(self).values()))

    def and_those(self, others: TeacherRays) -> TeacherRays:
        """These rays and the `others` behind them."""
        both = zip(vars(self).values(), vars(others).values(), strict=True)
        return TeacherRays(*(np.concatenate(columns) for columns in both))


@dataclass(frozen=True, eq=False)
class TrainingRays:
    """n of the teacher's rays, and the baked grid, in which all of them meet something. What a ray fetches is
    found whenever a batch needs it, for the samples of all rays would take more memory than the grid where
    there is fog. Where there is none they are kept, which saves a quarter of a step's time."""

    teacher: TeacherRays
    grid: SparseGrid
    """As the player has it."""
    n_fetches: int
    """The player's k, 0 for every sample."""
    densities: VertexRows | None
    """Rows of the stored densities where they are trained too."""
    samples: KeptSamples | None = None
    """Where all rays have samples, if that is kept."""

    def __len__(self) -> int:
        return len(self.teacher.opacity)

    def some(self, n: int) -> TrainingRays:
        """n of the rays, spread evenly; all where there are no more."""
        return replace(self, teacher=self.teacher.some(n))

    def with_samples(self) -> TrainingRays:
        """The rays with all their samples kept, for whoever needs them many times and weighs them himself.
        Without where they are too many, and in contracted space, where the grid takes the memory."""
        return self if self.grid.contracted else replace(self, samples=_all_samples(self))

    def fetches(self, some: np.ndarray) -> Fetches:
        """The fetches of the rays whose numbers are in `some`, in that order. With kept `samples` the weights
        and the opacity are left for `weigh` to fill in."""
        if self.samples is not None:
            starts, points, lengths = self.samples.of(some)
            weights, opacity = np.empty_like(lengths), np.empty(len(some), np.float32)
            return self._placed(starts, points, weights, lengths, opacity)
        rays_o, rays_d = self.teacher.rays_o[some], self.teacher.rays_d[some]
        found = player_fetches(self.grid, rays_o, rays_d, self.n_fetches)
        counts, opacity = np.zeros(len(some), np.int64), np.zeros(len(some), np.float32)
        counts[found.hits], opacity[found.hits] = found.counts, found.opacity
        starts = np.concatenate([[0], np.cumsum(counts)])
        return self._placed(starts, found.points, found.weights, found.lengths, opacity)

    def _placed(
        self,
        starts: np.ndarray,
        points: np.ndarray,
        weights: np.ndarray,
        lengths: np.ndarray,
        opacity: np.ndarray,
    ) -> Fetches:
        """The fetches at `points` [n_fetches, 3], cells of the densities' grid."""
        of_features = corners(self.grid.rows, points * self.grid.feature_scale, MIN_TOTAL)
        none = Corners(np.zeros((0, 8), np.int32), np.zeros((0, 8), np.float32))
        of_densities = none if self.densities is None else corners(self.densities, points, np.float32(0))
        return Fetches(starts, of_features, of_densities, weights, lengths, opacity)

    def composed(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """([n, n_channels] float32 composites of `codes` [n_vertices, n_channels] float32, rounded; [n]
        float32 opacity of the baked grid)."""
        out, opacity = np.empty((len(self), codes.shape[1]), np.float32), np.empty(len(self), np.float32)
        for first in range(0, len(self), RAYS_AT_ONCE):
            some = np.arange(first, min(first + RAYS_AT_ONCE, len(self)))
            fetches = self.fetches(some)
            out[some], opacity[some] = fetches.compose(codes), fetches.opacity
        return out, opacity

    def typical(self, codes: np.ndarray) -> np.ndarray:
        """[n_channels] mean size of the composites of `codes` over some of the rays; never 0."""
        composites, _ = self.some(N_TYPICAL).composed(codes)
        return np.maximum(np.abs(composites).mean(axis=0), 1e-3)


class KeptSamples(NamedTuple):
    """Where n rays have samples, at every one of which the player fetches."""

    starts: np.ndarray
    """[n + 1] int64: ray i has the samples starts[i] to starts[i + 1]."""
    points: np.ndarray
    """[n_samples, 3] float32 places, cells of the densities' grid."""
    lengths: np.ndarray
    """[n_samples] float32 length of the ray that a sample stands for, model units."""

    def of(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(starts, points, lengths) of the rays whose numbers are in `some`, in that order."""
        starts = np.concatenate([[0], np.cumsum(self.starts[some + 1] - self.starts[some])])
        points, lengths = np.empty((starts[-1], 3), np.float32), np.empty(starts[-1], np.float32)
        take_runs(some, self.starts, self.points, self.lengths, starts, points, lengths)
        return starts, points, lengths


def _all_samples(rays: TrainingRays) -> KeptSamples | None:
    """All samples of `rays`; None where they are more than MOST_KEPT."""
    n_rays, n = len(rays), 0
    counts = np.zeros(n_rays, np.int64)
    points, lengths = np.empty((MOST_KEPT, 3), np.float32), np.empty(MOST_KEPT, np.float32)
    for first in range(0, n_rays, RAYS_AT_ONCE):
        some = slice(first, first + RAYS_AT_ONCE)
        found = player_fetches(rays.grid, rays.teacher.rays_o[some], rays.teacher.rays_d[some], 0)
        end = n + len(found.lengths)
        if end > MOST_KEPT:
            return None
        points[n:end], lengths[n:end] = found.points, found.lengths
        counts[first + found.hits] = found.counts
        n = end
    return KeptSamples(np.concatenate([[0], np.cumsum(counts)]), points[:n], lengths[:n])


def photographed_rays(model: Model, most: int, progress: Progress) -> TeacherRays:
    """At most `most` of the rays through the model's training pixels, spread evenly, and the mean of what the
    photographs and the full model show there.

    A photograph has what the model has not learned, and what no other photograph shows: noise, or a camera
    that is a little wrong. The model's errors are others, so that the mean of both is nearer to what other
    views show than either (docs/notes/2026-11-26-photographs-in-refinement.md).
    """
    rays_o, rays_d, rgba = model.training_pixel_rays()
    shown = rgba.astype(np.float32) / 255
    rays = TeacherRays(rays_o, rays_d, shown[:, :3] * shown[:, 3:], shown[:, 3].copy()).some(most)
    n = len(rays.opacity)
    for first in range(0, n, FIELD_RAYS_AT_ONCE):
        some = slice(first, first + FIELD_RAYS_AT_ONCE)
        colours, opacity = _shown(model, rays.rays_o[some], rays.rays_d[some])
        rays.colours[some] += (colours - rays.colours[some]) / 2
        rays.opacity[some] += (opacity - rays.opacity[some]) / 2
        progress(min(first + FIELD_RAYS_AT_ONCE, n), n)
    return rays


def render_teacher(
    model: Model, cameras: list[Camera], n_rays: int, seed: int, progress: Progress
) -> TeacherRays:
    """The full model on about `n_rays` random pixels of `cameras` (model frame); those at which it has
    nothing to show are left out."""
    random = np.random.default_rng(seed)
    parts = []
    for done, camera in enumerate(cameras):
        n_pixels = camera.width * camera.height
        some = random.choice(n_pixels, min(n_pixels, max(n_rays // len(cameras), 1)), replace=False)
        rays_o, rays_d = camera.rays_through(some)
        colours, opacity = _shown(model, rays_o, rays_d)
        met = np.flatnonzero(opacity > 0)
        parts.append((rays_o[met], rays_d[met], colours[met], opacity[met]))
        progress(done + 1, len(cameras))
    return TeacherRays(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _shown(model: Model, rays_o: np.ndarray, rays_d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The full model's colours times opacity [n, 3] and opacity [n] float32 on rays [n, 3]."""
    features, opacity, _ = model.sampler.composited_features(model.field, rays_o, rays_d)
    colours, met = np.zeros((len(opacity), 3), np.float32), np.flatnonzero(opacity > 0)
    colours[met] = head_colours(model.field, features[met], rays_d[met]) * opacity[met, None]
    return colours, opacity


def collect_training_rays(
    teacher: TeacherRays, grid: SparseGrid, n_fetches: int, densities: VertexRows | None = None
) -> TrainingRays:
    """Those of the teacher's rays that meet something in the grid.

    Args:
        teacher: rays and what the full model shows on them.
        grid: as the player has it.
        n_fetches: the player's k, 0 for every sample.
        densities: rows of the stored densities, where they are trained too; needs every sample.

    Raises TrainingError where no ray meets anything.
    """
    meets = np.zeros(len(teacher.opacity), bool)
    for first in range(0, len(meets), RAYS_AT_ONCE):
        rows = slice(first, first + RAYS_AT_ONCE)
        sampled = sample_rays(grid, teacher.rays_o[rows], teacher.rays_d[rows], get_num_threads())
        meets[rows] = -np.expm1(-sampled.tau) > MIN_OPACITY
    if not meets.any():
        raise TrainingError("the baked grid shows nothing in any training view: train longer")
    return TrainingRays(teacher.chosen(np.flatnonzero(meets)), grid, n_fetches, densities)


class PlayerFetches(NamedTuple):
    """What the player fetches on the rays that hit."""

    hits: np.ndarray
    """[n_hits] numbers of the rays that hit."""
    opacity: np.ndarray
    """[n_hits] float32."""
    counts: np.ndarray
    """[n_hits] number of fetches of each ray."""
    points: np.ndarray
    """[n_fetches, 3] float32 places, cells of the densities' grid."""
    weights: np.ndarray
    """[n_fetches] float32 compositing weights."""
    lengths: np.ndarray
    """[n_fetches] float32 length of the ray that a sample stands for, model units; 0 for what several samples
    were merged into."""


def player_fetches(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, n_fetches: int) -> PlayerFetches:
    """Where the player fetches features on the rays [n, 3], and how much each fetch weighs, as
    `player.march.march` composes them with k = `n_fetches`."""
    samples, ways, tau, _, places = sample_rays(grid, rays_o, rays_d, get_num_threads())
    opacity = -np.expm1(-tau)
    hits = np.flatnonzero(opacity > MIN_OPACITY)
    is_hit = np.zeros(len(opacity), bool)
    is_hit[hits] = True
    counts = np.bincount(samples.ray, minlength=len(opacity))
    merged = is_hit[samples.ray] & (counts[samples.ray] > n_fetches) & (n_fetches > 0)
    kept = is_hit[samples.ray] & ~merged
    ray, points, weights, lengths = (column[kept] for column in (samples.ray, places, samples.weights, ways))
    if merged.any():
        bins = equal_mass_bins(Samples(*(column[merged] for column in samples)), n_fetches)
        at = np.ascontiguousarray(path_of(grid, rays_o, rays_d).at(bins.ray, bins.s).T)
        gaps = np.flatnonzero(~corners(grid.rows, at * grid.feature_scale, MIN_TOTAL)[1].any(axis=1))
        if len(gaps):
            at[gaps] = places[merged][heaviest(bins, gaps)]
        ray = np.concatenate([ray, bins.ray])
        points = np.concatenate([points, at])
        weights = np.concatenate([weights, opacity[bins.ray] / np.float32(n_fetches)])
        lengths = np.concatenate([lengths, np.zeros(len(bins.ray), np.float32)])
        order = np.argsort(ray, kind="stable")
        ray, points, weights, lengths = ray[order], points[order], weights[order], lengths[order]
    counts = np.bincount(ray, minlength=len(opacity))[hits]
    return PlayerFetches(hits, opacity[hits], counts, points, weights.astype(np.float32), lengths)


def corners(vertices: VertexRows, points: np.ndarray, least: np.float32) -> Corners:
    """The corners around `points` [n, 3] float32, in cells of the vertices' own grid. Shares are 0 where
    those of the stored vertices are less than `least` in all."""
    n = len(points)
    rows, shares = np.empty((n, 8), np.int32), np.empty((n, 8), np.float32)
    corner_rows(
        points, vertices.resolution, vertices.n_per_axis, vertices.bricks, vertices.rows, least, rows, shares,
    )  # fmt: skip
    return Corners(rows, shares)


def with_field_features(
    model: Model,
    layout: Layout,
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    played: MarchResult,
) -> MarchResult:
    """`played`, the march of the rays [n, 3] through `grid` at every sample, with all features of the field
    as if the vertices stored them unrounded. They are evaluated where the rays meet them, because those of a
    large grid would take gigabytes."""
    features = np.zeros((len(played.hits), model.field.config.n_channels), np.float32)
    numbers = np.empty(len(layout.features), np.int32)
    for first in range(0, len(features), FIELD_RAYS_AT_ONCE):
        rays = played.hits[first : first + FIELD_RAYS_AT_ONCE]
        fetches = player_fetches(grid, rays_o[rays], rays_d[rays], 0)
        features[first + fetches.hits] = _field_features(model, layout, grid, fetches, numbers)
    return played._replace(features=features)


def _field_features(
    model: Model, layout: Layout, grid: SparseGrid, fetches: PlayerFetches, numbers: np.ndarray
) -> np.ndarray:
    """[n_hits, n_channels] composites of the field's features at the stored vertices. `numbers` [n_features]
    int32 is worked in."""
    rows, shares = corners(grid.rows, fetches.points * grid.feature_scale, MIN_TOTAL)
    numbers[:] = 0
    numbers[rows] = 1
    met = np.flatnonzero(numbers)
    numbers[met] = np.arange(len(met))
    at = unit_points(layout.features.index[met], layout.features.resolution, layout.contracted)
    vertices = model.field.features(at)
    starts = np.concatenate([[0], np.cumsum(fetches.counts)])
    out = np.empty((len(fetches.hits), vertices.shape[1]), np.float32)
    compose(starts, numbers[rows], shares, fetches.weights, vertices, out)
    return out
