"""What rays see differently where a coarser level shows a brick.

Letters: a ray meets samples j at x_j with weights w_j; those in one brick b of the finest level are a segment
of the ray. Level l says F_l at a place, the finest F_0.

Features: sum_{j in b} w_j (F_l(x_j) - F_0(x_j)) is the change of what the ray composites, and the error is
its square, summed over channels and rays. Stored channels are scaled so that an error in any of them weighs
alike in the colours (`vfr_bake.baking.grids`).

Densities: the segment has the optical depth d_0 with the finest level, d_l with the coarser one, and the
light that reaches it is T. The error is the square of T (exp(-d_l) - exp(-d_0)), by which the ray's colour
moves from what the segment shows towards what is behind it, summed over the rays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import get_num_threads

from player.asset.grid import SPARE, SparseGrid, brick_number, build_grid, vertex_rows
from player.asset.pyramid import Bricks, Pyramid, PyramidValues
from player.compiled.samples import sample_rays
from player.march.fetches import MIN_TOTAL
from vfr_bake.baking.distillation import TeacherRays, corners
from vfr_bake.kernels.sample_weights import add_corner_weights
from vfr_bake.kernels.stored_features import compose

RAYS_AT_ONCE = 1 << 12
"""Few, because a ray through fog has hundreds of samples, of 100 to 200 bytes each meanwhile."""

_NONE = Bricks(np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64))


def alone(pyramid: Pyramid, level: int) -> Pyramid:
    """The pyramid with one of its levels alone."""
    return Pyramid(pyramid.resolution, (*(_NONE,) * level, pyramid.levels[level]))


def finest_numbers(pyramid: Pyramid, n_per_axis: int) -> np.ndarray:
    """[n_bricks] int64: where the bricks of the finest level are in an array over all bricks."""
    return brick_number(pyramid.levels[0].coords.astype(np.int64).T << 3, n_per_axis)


@dataclass(frozen=True, eq=False)
class LevelsOfFeatures:
    """Features of which each brick of the finest level may be shown by any of some levels."""

    grid: SparseGrid
    """As the player has it, with the features of all these levels."""
    entries: np.ndarray
    """[n_levels, n_bricks] int32: what the table of rows has for each brick of the finest level."""
    numbers: np.ndarray
    """[n_bricks]: where in the table they are."""

    def at(self, levels: np.ndarray | int) -> SparseGrid:
        """The grid with each brick of the finest level shown by one of `levels`."""
        rows, bricks = self.grid.rows, self.grid.rows.bricks.copy()
        bricks[self.numbers] = self.entries[levels, np.arange(len(self.numbers))]
        return replace(self.grid, rows=replace(rows, bricks=bricks))


def levels_of_features(
    grid: SparseGrid, pyramid: Pyramid, codes: np.ndarray, n_levels: int
) -> LevelsOfFeatures:
    """The features of the `n_levels` finest levels of a pyramid: `codes` int8 [n_vertices, n_channels], one
    level's after the other's."""
    found = [vertex_rows(alone(pyramid, level)) for level in range(n_levels)]
    numbers = finest_numbers(pyramid, found[0].n_per_axis)
    entries, rows = [], []
    n_bricks = n_rows = 0
    for level, of_level in enumerate(found):
        at = of_level.bricks[numbers] >> 3
        entries.append((at + n_bricks) << 3 | level)
        rows.append(np.where(of_level.rows >= 0, of_level.rows + np.int32(n_rows), -1).astype(np.int32))
        n_bricks += len(of_level.rows) // 729
        n_rows += pyramid.vertices[level].n
    together = replace(found[0], rows=np.concatenate(rows))
    return LevelsOfFeatures(
        replace(grid, rows=together, features=codes[:n_rows]), np.array(entries, np.int32), numbers
    )


@dataclass(frozen=True, eq=False)
class LevelsOfDensities:
    """Densities of which each brick of the finest level may be shown by any of some levels."""

    grid: SparseGrid
    """As the player has it, with the densities of all these levels."""
    entries: np.ndarray
    """[n_levels, n_bricks] int32: what the table has for each brick of the finest level."""
    numbers: np.ndarray
    """[n_bricks]: where in the table they are."""

    def at(self, levels: np.ndarray | int) -> SparseGrid:
        """The grid with each brick of the finest level shown by one of `levels`."""
        table = self.grid.table.copy()
        table[self.numbers] = self.entries[levels, np.arange(len(self.numbers))]
        return replace(self.grid, table=table)


def levels_of_densities(
    grid: SparseGrid, pyramid: Pyramid, values: Sequence[np.ndarray]
) -> LevelsOfDensities:
    """The densities `values` of the finest levels of a pyramid, uint8 [n_vertices, 1] each; the grid is that
    of the finest alone."""
    numbers = finest_numbers(pyramid, grid.n_per_axis)
    nothing = PyramidValues(Pyramid(1, (_NONE,)), (np.zeros((0, 1), np.int8),))
    box = np.stack([grid.aabb_min, grid.aabb_min + grid.resolution / grid.cells_per_unit])
    entries, parts = [], []
    n_slots = 0
    for level, codes in enumerate(values):
        own = (*(np.zeros((0, 1), np.uint8),) * level, codes)
        one = build_grid(
            PyramidValues(alone(pyramid, level), own), nothing, box, float(grid.step), (1,) * (level + 1),
            (0.0, 1.0),
        )  # fmt: skip
        entries.append(one.table[numbers] + (n_slots << 3))
        parts.append((one.codes.reshape(-1), one.live, one.slot_coords, one.slot_levels))
        n_slots += len(one.slot_coords)
    density, live, coords, levels = (np.concatenate(column) for column in zip(*parts, strict=True))
    together = replace(
        grid, density=np.append(density, np.zeros(SPARE, np.uint8)), live=live, slot_coords=coords,
        slot_levels=levels, level_steps=np.ones(len(values), np.int32),
    )  # fmt: skip
    return LevelsOfDensities(together, np.array(entries, np.int32), numbers)


class Segments(NamedTuple):
    """Samples of rays, one ray's after the other's, in segments that lie in one brick each."""

    points: np.ndarray
    """[n_samples, 3] float32, cells of the densities' grid."""
    weights: np.ndarray
    """[n_samples] float32."""
    left: np.ndarray
    """[n_samples] float64: the light that reaches each, T."""
    ray: np.ndarray
    """[n_samples] int64."""


def samples_of(grid: SparseGrid, rays: TeacherRays) -> Iterator[Segments]:
    """The samples with weight of the rays, some rays at a time."""
    for first in range(0, len(rays.opacity), RAYS_AT_ONCE):
        some = slice(first, first + RAYS_AT_ONCE)
        sampled = sample_rays(grid, rays.rays_o[some], rays.rays_d[some], get_num_threads())
        samples = sampled.samples
        weights = samples.weights.astype(np.float64)
        running = np.cumsum(weights)
        begins = np.searchsorted(samples.ray, np.arange(len(rays.rays_o[some])))
        before = np.concatenate([[0.0], running])[begins]
        left = 1 - (running - weights - before[samples.ray])
        yield Segments(sampled.points, samples.weights, left, samples.ray)


def heavy_vertices(levels: LevelsOfFeatures, n: int, rays: TeacherRays) -> np.ndarray:
    """[n] float32 above 0: the summed weights of the samples around each vertex of the finest level, and a
    little for those that nothing sees."""
    grid, totals = levels.at(0), np.zeros(n, np.float32)
    for samples in samples_of(grid, rays):
        rows, shares = corners(grid.rows, samples.points * grid.feature_scale, MIN_TOTAL)
        add_corner_weights(rows, shares, samples.weights, totals)
    return totals + np.float32(max(1e-2 * float(totals.mean()), 1e-6))


def feature_errors(levels: LevelsOfFeatures, rays: TeacherRays) -> np.ndarray:
    """[n_levels, n_bricks] float64: the errors of each level in each brick of the finest, those of the finest
    0."""
    n_levels, n_bricks = levels.entries.shape
    grids = [levels.at(level) for level in range(n_levels)]
    rows, size = grids[0].rows, np.float32(grids[0].rows.resolution)
    which = np.full(rows.n_per_axis**3, -1)
    which[levels.numbers] = np.arange(n_bricks)
    out = np.zeros((n_levels, n_bricks))
    features = levels.grid.features
    for samples in samples_of(grids[0], rays):
        points = samples.points * grids[0].feature_scale
        cells = np.clip(points, 0, size - 1).astype(np.int64)
        bricks = which[brick_number(cells.T, rows.n_per_axis)]
        begins = np.ones(len(bricks), bool)
        begins[1:] = (bricks[1:] != bricks[:-1]) | (samples.ray[1:] != samples.ray[:-1])
        first = np.flatnonzero(begins)
        starts = np.append(first, len(bricks)).astype(np.int64)
        seen = []
        for grid in grids:
            composed = np.empty((len(first), features.shape[1]), np.float32)
            where = corners(grid.rows, points, MIN_TOTAL)
            compose(starts, *where, samples.weights, features, composed)
            seen.append(composed)
        known = bricks[first] >= 0
        for level in range(1, n_levels):
            error = ((seen[level] - seen[0]) ** 2).sum(axis=1, dtype=np.float64)
            out[level] += np.bincount(bricks[first][known], error[known], n_bricks)
    return out


def density_errors(levels: LevelsOfDensities, rays: TeacherRays) -> np.ndarray:
    """As `feature_errors`, of densities."""
    n_levels, n_bricks = levels.entries.shape
    which = np.full(len(levels.grid.table), -1)
    which[levels.numbers] = np.arange(n_bricks)
    out = np.zeros((n_levels, n_bricks))
    grids = [levels.at(level) for level in range(n_levels)]
    for first in range(0, len(rays.opacity), RAYS_AT_ONCE):
        some = rays.chosen(slice(first, first + RAYS_AT_ONCE))
        parts = []
        for grid in grids:
            (samples,) = samples_of(grid, some)
            bricks = which[brick_number(grid.cells(samples.points.T), grid.n_per_axis)]
            depths = -np.log1p(-np.minimum(samples.weights / np.maximum(samples.left, 1e-9), 1 - 1e-9))
            known = bricks >= 0
            keys = samples.ray[known] * n_bricks + bricks[known]
            # A ray's samples in a brick follow each other: they are added up before anything is sorted.
            begins = np.flatnonzero(np.diff(keys, prepend=-1))
            depths = np.add.reduceat(depths[known], begins) if len(begins) else depths[:0]
            parts.append((keys[begins], depths, samples.left[known][begins]))
        for level in range(1, n_levels):
            (own, own_depths, left), (keys, depths, _) = parts[0], parts[level]
            segments, where = np.unique(np.concatenate([own, keys]), return_inverse=True)
            n, before = len(segments), len(own)
            fine = np.bincount(where[:before], own_depths, n)
            coarse = np.bincount(where[before:], depths, n)
            light = np.zeros(n)
            np.maximum.at(light, where, np.concatenate([left, parts[level][2]]))
            error = (light * (np.exp(-coarse) - np.exp(-fine))) ** 2
            out[level] += np.bincount(segments % n_bricks, error, n_bricks)
    return out
