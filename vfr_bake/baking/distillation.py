"""Training data of the refinement (distillation): the colours that the full model and photographs show on
rays, and the player's compositing on these rays, in a form in which the stored values can be trained.

Where the player fetches features, and how much each fetch weighs, depends on the densities alone. With fixed
densities, the composite of a ray is thus a fixed linear map of the stored feature codes,
x = sum_j weights[j] sum_c shares[j, c] codes[rows[j, c]]. `Fetches` holds this map for training rays, at the
places where the player itself fetches. If the densities are trained too, which needs every sample, `Fetches`
also holds the places of the density codes.

With the field's own features in place of the stored codes, the same map gives the loss by the grid alone.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import get_num_threads

from player.asset.grid import SparseGrid, VertexRows
from player.cameras.camera import Camera
from player.compiled.samples import fetch_places, sample_rays
from player.errors import TrainingError
from player.march.fetches import MIN_TOTAL
from player.march.march import MIN_OPACITY, MarchResult
from player.progress import Progress, Report
from vfr_bake.baking.grids import Layout, unit_points
from vfr_bake.baking.held_out import BETWEEN, views_between
from vfr_bake.kernels.stored_features import compose, composite, corner_rows, interpolate, padded, take_runs
from vfr_bake.rendering.render import Compositor, colours_of_features
from vfr_bake.training.model_file import Model

RAYS_AT_ONCE = 1 << 12
"""Kept small: a ray through fog has hundreds of samples, and each takes 100 to 200 bytes while they are
processed."""
FIELD_RAYS_AT_ONCE = 1 << 13
"""Rays on which the field is evaluated at a time."""
KEPT_BYTES = 16
"""Bytes of a fetch that is kept in memory: its point, and its length or weight, in float32."""
N_PROBED = 8
"""Batches of rays after which it is judged whether fetches are worth keeping."""
PHOTOGRAPHED = 3 / 4
"""Share of the training rays that go through training pixels, if the model has that many pixels. An object's
training pixels all lie on it or close to it; of its other rays only a third meet something."""
N_TYPICAL = 4096
"""Training rays from which the typical size of composites is computed."""


class Corners(NamedTuple):
    """The stored vertices around n points, with their shares in the trilinear interpolation."""

    rows: np.ndarray
    """[n, 8] int32 rows of the stored vertices."""
    shares: np.ndarray
    """[n, 8] float32 shares of these vertices."""


class Fetches(NamedTuple):
    """The fetches of n rays, in the form that `vfr_bake.kernels.stored_features` takes."""

    starts: np.ndarray
    """[n + 1] int64: ray i has the fetches starts[i] to starts[i + 1]."""
    features: Corners
    """The stored features around each fetch. Its shares add up to 1, or are all 0 if too little is stored."""
    densities: Corners
    """The stored densities around each fetch. The shares of missing vertices are 0. Empty, [0, 8], if
    densities are not trained."""
    weights: np.ndarray
    """[n_fetches] float32 compositing weights."""
    lengths: np.ndarray
    """[n_fetches] float32 length of the piece of ray that each sample stands for, model units. Without
    densities it may be empty."""
    opacity: np.ndarray
    """[n] float32 opacity of the baked grid."""

    def compose(self, features: np.ndarray) -> np.ndarray:
        """Return the composites [n, n_channels] float32 of latent `features` [n_vertices, n_channels] int16,
        rounded to codes."""
        out = np.empty((len(self.opacity), features.shape[1]), np.float32)
        compose(self.starts, *self.features, self.weights, features, out)
        return out

    def interpolate(self, features: np.ndarray) -> np.ndarray:
        """Return [n_fetches, `padded(n_channels)`] float32: the latent `features`, rounded to codes and
        interpolated at each fetch."""
        out = np.empty((len(self.weights), padded(features.shape[1])), np.float32)
        interpolate(*self.features, self.weights, features, out)
        return out

    def composite(self, values: np.ndarray, n_channels: int) -> np.ndarray:
        """Return the composites [n, n_channels] float32 of interpolated `values` from `interpolate`."""
        out = np.empty((len(self.opacity), n_channels), np.float32)
        composite(self.starts, self.weights, values, out)
        return out


@dataclass(frozen=True, eq=False)
class TeacherRays:
    """n rays and their target colours: those of the full model, or the mean of these and a photograph's."""

    rays_o: np.ndarray
    """[n, 3] float32, model frame."""
    rays_d: np.ndarray
    """[n, 3] float32, of unit length."""
    colours: np.ndarray
    """[n, 3] float32 colours times opacity."""
    opacity: np.ndarray
    """[n] float32 opacity."""

    def some(self, n: int) -> TeacherRays:
        """Return n of the rays, spread evenly; all of them if there are no more."""
        n_all = len(self.opacity)
        if n >= n_all:
            return self
        return self.chosen(np.arange(n) * n_all // n)

    def chosen(self, rays: np.ndarray | slice) -> TeacherRays:
        """Return the rays with these numbers."""
        return TeacherRays(*(column[rays] for column in vars(self).values()))

    def and_those(self, others: TeacherRays) -> TeacherRays:
        """Return these rays, followed by the `others`."""
        both = zip(vars(self).values(), vars(others).values(), strict=True)
        return TeacherRays(*(np.concatenate(columns) for columns in both))


@dataclass(frozen=True, eq=False)
class TrainingRays:
    """n of the teacher's rays, all of which meet something in the baked grid.

    The places of the fetches are kept if there is memory for them, which saves a third of a step's time. If
    not, they are computed whenever a batch needs them: in fog, those of all rays would take more memory than
    the grid.
    """

    teacher: TeacherRays
    grid: SparseGrid
    """The baked grid, as the player has it."""
    n_fetches: int
    """Feature lookups of a ray (the player's k), 0 for every sample."""
    densities: VertexRows | None
    """Rows of the stored densities; None if densities are not trained."""
    kept: KeptFetches | None = None
    """The fetches of all rays; None if they are not kept."""

    def __len__(self) -> int:
        return len(self.teacher.opacity)

    def some(self, n: int) -> TrainingRays:
        """Return n of the rays, spread evenly, without kept fetches; all of them if there are no more."""
        return replace(self, teacher=self.teacher.some(n), kept=None)

    def fetches(self, some: np.ndarray) -> Fetches:
        """Return the fetches of the rays whose numbers are in `some`, in that order. If they are kept and
        densities are trained, weights and opacity are left uninitialised, for `weigh` to fill in."""
        if self.kept is not None:
            starts, points, numbers = self.kept.of(some)
            if self.densities is None:
                return self._placed(starts, points, numbers, numbers[:0], self.kept.opacity[some])
            weights, opacity = np.empty_like(numbers), np.empty(len(some), np.float32)
            return self._placed(starts, points, weights, numbers, opacity)
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
        """Return the fetches at `points` [n_fetches, 3], given in cells of the densities' grid."""
        of_features = corners(self.grid.rows, points * self.grid.feature_scale, MIN_TOTAL)
        none = Corners(np.zeros((0, 8), np.int32), np.zeros((0, 8), np.float32))
        of_densities = none if self.densities is None else corners(self.densities, points, np.float32(0))
        return Fetches(starts, of_features, of_densities, weights, lengths, opacity)

    def composed(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Composite latent features `codes` [n_vertices, n_channels] int16, rounded to codes.

        Returns the composites [n, n_channels] float32 and the opacity [n] float32 of the baked grid.
        """
        out, opacity = np.empty((len(self), codes.shape[1]), np.float32), np.empty(len(self), np.float32)
        for first in range(0, len(self), RAYS_AT_ONCE):
            some = np.arange(first, min(first + RAYS_AT_ONCE, len(self)))
            fetches = self.fetches(some)
            out[some], opacity[some] = fetches.compose(codes), fetches.opacity
        return out, opacity

    def typical(self, codes: np.ndarray) -> np.ndarray:
        """Return [n_channels]: the mean magnitude of the composites of `codes` over some of the rays; never
        0."""
        composites, _ = self.some(N_TYPICAL).composed(codes)
        return np.maximum(np.abs(composites).mean(axis=0), 1e-3)


class KeptFetches(NamedTuple):
    """The places of all fetches of n rays."""

    starts: np.ndarray
    """[n + 1] int64: ray i has the fetches starts[i] to starts[i + 1]."""
    points: np.ndarray
    """[n_fetches, 3] float32 places, in cells of the densities' grid."""
    numbers: np.ndarray
    """[n_fetches] float32: the lengths of the pieces of ray that the fetches stand for, model units, if
    densities are trained; the fetches' weights if they are not."""
    opacity: np.ndarray
    """[n] float32 opacity of the baked grid before training."""

    def of(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (starts, points, numbers) of the rays whose numbers are in `some`, in that order."""
        starts = np.concatenate([[0], np.cumsum(self.starts[some + 1] - self.starts[some])])
        points, numbers = np.empty((starts[-1], 3), np.float32), np.empty(starts[-1], np.float32)
        take_runs(some, self.starts, self.points, self.numbers, starts, points, numbers)
        return starts, points, numbers


@dataclass(frozen=True)
class Keeping:
    """Limits on the fetches of all training rays that are kept."""

    n_bytes: int
    """Bytes that they may take."""
    seconds: float
    """Seconds that it may take to find them all. In fog, where a ray has hundreds of samples, it would take
    longer than to find those of the rays that the steps draw."""


class _Keeper:
    """Keeps the fetches of rays that are marched in `n_batches` batches, as long as they are within
    limits."""

    def __init__(self, limits: Keeping, n_batches: int) -> None:
        # Memory pages are only taken for the fetches that there are.
        self._points = np.empty((limits.n_bytes // KEPT_BYTES, 3), np.float32)
        self._numbers = np.empty(limits.n_bytes // KEPT_BYTES, np.float32)
        self._counts, self._opacity, self._n = list[np.ndarray](), list[np.ndarray](), 0
        self._limits, self._n_batches = limits, n_batches
        self._begun = 0.0

    def keep(self, found: PlayerFetches, numbers: np.ndarray) -> bool:
        """Keep the fetches of a batch of rays, and their lengths or weights in `numbers`. Return whether all
        are expected to be within the limits."""
        end = self._n + len(numbers)
        if end > len(self._numbers):
            return False
        self._points[self._n : end], self._numbers[self._n : end] = found.points, numbers
        self._counts.append(found.counts)
        self._opacity.append(found.opacity)
        self._n = end
        n_kept = len(self._counts)
        if n_kept == 1:
            self._begun = time.monotonic()  # code may be compiled for the first batch
        elif n_kept == N_PROBED:
            seconds = (time.monotonic() - self._begun) * self._n_batches / (N_PROBED - 1)
            # Batches of other views may have fewer fetches.
            few = self._n * self._n_batches < 2 * N_PROBED * len(self._numbers)
            return few and seconds <= self._limits.seconds
        return True

    def kept(self) -> KeptFetches:
        """Return the fetches of all rays that hit something."""
        starts = np.concatenate([[0], np.cumsum(np.concatenate(self._counts))])
        opacity = np.concatenate(self._opacity)
        return KeptFetches(starts, self._points[: self._n], self._numbers[: self._n], opacity)


def teacher_rays(
    model: Model, n_rays: int, wide: bool, report: Report, sampler: Compositor | None = None
) -> TeacherRays:
    """Make about `n_rays` training rays: through training pixels, and in views between the training cameras,
    which have a border if `wide`. `sampler` stands for the model's own sampler, if it is given."""
    cameras = model.model_cameras()
    views = views_between(model, BETWEEN * len(cameras), seed=1, wide=wide)
    n_photographed = photographed(model, n_rays)
    if not n_photographed:
        views = cameras + views
    teacher = render_teacher(model, views, n_rays - n_photographed, 0, partial(report, "teacher"), sampler)
    if n_photographed:
        progress = partial(report, "photographs")
        teacher = teacher.and_those(photographed_rays(model, n_photographed, progress, sampler))
    return teacher


def photographed(model: Model, n_rays: int) -> int:
    """Return how many of `n_rays` training rays go through training pixels of the model."""
    n_pixels = 0 if model.training_pixels is None else len(model.training_pixels.pixels)
    return min(int(PHOTOGRAPHED * n_rays), n_pixels)


def photographed_rays(
    model: Model, most: int, progress: Progress, sampler: Compositor | None = None
) -> TeacherRays:
    """Return at most `most` of the rays through the model's training pixels, spread evenly, with the mean of
    the colours of the photographs and of the full model as targets.

    A photograph contains detail that the model has not learned, but also errors that no other photograph has:
    noise, or a camera that is a little wrong. The model has different errors, so the mean of both is nearer
    to what other views show than either alone (docs/notes/2026-11-26-photographs-in-refinement.md).

    Opaque photographs of an object show its background, too, and do not tell where the object ends. There
    the opacity is the model's alone, and the photograph's colour is what is left of it without the part of
    the background that the model lets through.

    `sampler` stands for the model's own sampler, if it is given.
    """
    rays_o, rays_d, rgba = model.training_pixel_rays()
    shown = rgba.astype(np.float32) / 255
    rays = TeacherRays(rays_o, rays_d, shown[:, :3] * shown[:, 3:], shown[:, 3].copy()).some(most)
    is_over_background = not (model.has_alpha or model.field.config.unbounded)
    n = len(rays.opacity)
    for first in range(0, n, FIELD_RAYS_AT_ONCE):
        some = slice(first, first + FIELD_RAYS_AT_ONCE)
        colours, opacity = colours_of_features(
            model.field, sampler or model.sampler, rays.rays_o[some], rays.rays_d[some]
        )
        if is_over_background:
            behind = (1 - opacity[:, None]) * model.background
            rays.colours[some] = (rays.colours[some] - behind).clip(0, opacity[:, None])
            rays.opacity[some] = opacity
        rays.colours[some] += (colours - rays.colours[some]) / 2
        rays.opacity[some] += (opacity - rays.opacity[some]) / 2
        progress(min(first + FIELD_RAYS_AT_ONCE, n), n)
    return rays


def render_teacher(
    model: Model,
    cameras: list[Camera],
    n_rays: int,
    seed: int,
    progress: Progress,
    sampler: Compositor | None = None,
) -> TeacherRays:
    """Render the full model at about `n_rays` random pixels of `cameras` (model frame). Pixels at which it
    shows nothing are left out. `sampler` stands for the model's own sampler, if it is given."""
    random = np.random.default_rng(seed)
    parts = []
    for done, camera in enumerate(cameras):
        n_pixels = camera.width * camera.height
        some = random.choice(n_pixels, min(n_pixels, max(n_rays // len(cameras), 1)), replace=False)
        rays_o, rays_d = camera.rays_through(some)
        colours, opacity = colours_of_features(model.field, sampler or model.sampler, rays_o, rays_d)
        met = np.flatnonzero(opacity > 0)
        parts.append((rays_o[met], rays_d[met], colours[met], opacity[met]))
        progress(done + 1, len(cameras))
    return TeacherRays(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def collect_training_rays(
    teacher: TeacherRays,
    grid: SparseGrid,
    n_fetches: int,
    densities: VertexRows | None = None,
    keeping: Keeping | None = None,
) -> TrainingRays:
    """Select those of the teacher's rays that meet something in the grid.

    Args:
        teacher: rays and their target colours.
        grid: the baked grid, as the player has it.
        n_fetches: feature lookups of a ray (the player's k), 0 for every sample.
        densities: rows of the stored densities, if they are trained too; this needs `n_fetches` = 0.
        keeping: limits within which the fetches of all rays are kept; None if they are not to be kept.

    Raises TrainingError if no ray meets anything.
    """
    meets = np.zeros(len(teacher.opacity), bool)
    keeper = None if keeping is None else _Keeper(keeping, -(-len(meets) // RAYS_AT_ONCE))
    for first in range(0, len(meets), RAYS_AT_ONCE):
        rows = slice(first, first + RAYS_AT_ONCE)
        rays = teacher.rays_o[rows], teacher.rays_d[rows]
        if keeper is None:
            sampled = sample_rays(grid, *rays, get_num_threads())
            meets[rows] = -np.expm1(-sampled.tau) > MIN_OPACITY
            continue
        found = player_fetches(grid, *rays, n_fetches)
        meets[first + found.hits] = True
        if not keeper.keep(found, found.weights if densities is None else found.lengths):
            keeper = None
    if not meets.any():
        raise TrainingError("the baked grid shows nothing in any training view: train longer")
    kept = None if keeper is None else keeper.kept()
    return TrainingRays(teacher.chosen(np.flatnonzero(meets)), grid, n_fetches, densities, kept)


class PlayerFetches(NamedTuple):
    """The player's fetches on those rays that hit something."""

    hits: np.ndarray
    """[n_hits] numbers of the rays that hit something."""
    opacity: np.ndarray
    """[n_hits] float32 opacity of these rays."""
    counts: np.ndarray
    """[n_hits] number of fetches of each ray."""
    points: np.ndarray
    """[n_fetches, 3] float32 places, in cells of the densities' grid."""
    weights: np.ndarray
    """[n_fetches] float32 compositing weights."""
    lengths: np.ndarray
    """[n_fetches] float32 length of the piece of ray that each sample stands for, model units; empty unless
    every sample is a fetch."""


def player_fetches(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, n_fetches: int) -> PlayerFetches:
    """Find the places where the player fetches features on the rays [n, 3], and the fetches' weights, as
    `player.march.march` has them with k = `n_fetches`."""
    if n_fetches:
        ray, points, weights, opacity = fetch_places(grid, rays_o, rays_d, n_fetches, get_num_threads())
        hits, lengths = np.flatnonzero(opacity > MIN_OPACITY), np.zeros(0, np.float32)
    else:
        samples, ways, tau, _, places = sample_rays(grid, rays_o, rays_d, get_num_threads())
        opacity = -np.expm1(-tau)
        hits = np.flatnonzero(opacity > MIN_OPACITY)
        is_kept = (opacity > MIN_OPACITY)[samples.ray]
        ray, points, weights, lengths = (
            column[is_kept] for column in (samples.ray, places, samples.weights, ways)
        )
    counts = np.bincount(ray, minlength=len(opacity))[hits]
    return PlayerFetches(hits, opacity[hits], counts, points, weights, lengths)


def corners(vertices: VertexRows, points: np.ndarray, least: np.float32) -> Corners:
    """Find the stored corners around `points` [n, 3] float32, in cells of the vertices' own grid.

    With a `least` above 0, the shares of the stored corners are scaled to add up to 1; they are all set to 0
    if their sum is below `least`.
    """
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
    """Return `played` with its features replaced by composites of the field's own features, as if the
    vertices stored all channels unrounded.

    `played` is the march of the rays [n, 3] through `grid` with a fetch at every sample. The field is
    evaluated only at the vertices that each batch of rays meets, because the features of all vertices of a
    large grid would take gigabytes.
    """
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
    """Return the composites [n_hits, n_channels] of the field's features at the stored vertices. `numbers`
    [n_features] int32 is scratch memory."""
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
