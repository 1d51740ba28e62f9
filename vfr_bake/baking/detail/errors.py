"""Measure the error that rays see if a coarser level shows a brick.

Letters: a ray meets samples j at x_j with weights w_j. Its samples in one brick b of the finest level form a
segment of the ray. F_l(x) is the value of level l at the place x; F_0 is that of the finest level.

Features: the ray's composite changes by sum_{j in b} w_j (F_l(x_j) - F_0(x_j)). The error is the square of
this change, summed over channels and rays. Stored channels are scaled so that an error in any of them counts
alike in the colours (`vfr_bake.baking.grids`).

Densities: the segment has the optical depth d_0 with the finest level and d_l with the coarser one; T is the
transmittance in front of it. The ray's colour moves by the share T (exp(-d_l) - exp(-d_0)) from what the
segment shows towards what is behind it. The error is the square of this share, summed over the rays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import get_num_threads

from player.asset.grid import SPARE, SparseGrid, brick_number, build_grid, vertex_rows
from player.asset.pyramid import NO_BRICKS, Pyramid, PyramidValues
from player.compiled.samples import sample_rays
from player.march.fetches import MIN_TOTAL
from vfr_bake.baking.distillation import TeacherRays, corners
from vfr_bake.kernels.sample_weights import add_corner_weights
from vfr_bake.kernels.stored_features import compose

RAYS_AT_ONCE = 1 << 12
"""Kept small: a ray through fog has hundreds of samples, and each takes 100 to 200 bytes while they are
processed."""


def alone(pyramid: Pyramid, level: int) -> Pyramid:
    """Return the pyramid with all levels but one removed; finer levels stay as empty ones."""
    return Pyramid(pyramid.resolution, (*(NO_BRICKS,) * level, pyramid.levels[level]))


def finest_numbers(pyramid: Pyramid, n_per_axis: int) -> np.ndarray:
    """Return [n_bricks] int64: the index of each brick of the finest level in a flat array with an entry for
    every brick of the box."""
    return brick_number(pyramid.levels[0].coords.astype(np.int64).T << 3, n_per_axis)


@dataclass(frozen=True, eq=False)
class BrickLevels:
    """The densities or the features of several levels, any of which may show each brick of the finest
    level."""

    grid: SparseGrid
    """The grid as the player has it, with the densities or the features of all these levels."""
    of_features: bool
    entries: np.ndarray
    """[n_levels, n_bricks] int32: the entry in the grid's table, or in that of the rows of the features, for
    each brick of the finest level, if it is shown by that level."""
    numbers: np.ndarray
    """[n_bricks]: the indices of these bricks in the table."""

    def at(self, levels: np.ndarray | int) -> SparseGrid:
        """Return the grid with each brick of the finest level shown by the level in `levels` [n_bricks], or
        all of them by the same level."""
        grid, rows = self.grid, self.grid.rows
        table = (rows.bricks if self.of_features else grid.table).copy()
        table[self.numbers] = self.entries[levels, np.arange(len(self.numbers))]
        if self.of_features:
            return replace(grid, rows=replace(rows, bricks=table))
        return replace(grid, table=table)


def levels_of_features(grid: SparseGrid, pyramid: Pyramid, codes: np.ndarray, n_levels: int) -> BrickLevels:
    """Make the features of the `n_levels` finest levels of a pyramid, of which any may show each brick.
    `codes` int8 [n_vertices, n_channels] are those of all levels, one after the other, the finest first."""
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
    grid = replace(grid, rows=together, features=codes[:n_rows])
    return BrickLevels(grid, True, np.array(entries, np.int32), numbers)


def levels_of_densities(grid: SparseGrid, pyramid: Pyramid, values: Sequence[np.ndarray]) -> BrickLevels:
    """Make the densities of the finest levels of a pyramid, of which any may show each brick.

    `values` are the codes of each of these levels, uint8 [n_vertices, 1]; `grid` is the grid of the finest
    level alone.
    """
    numbers = finest_numbers(pyramid, grid.n_per_axis)
    nothing = PyramidValues(Pyramid(1, (NO_BRICKS,)), (np.zeros((0, 1), np.int8),))
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
    return BrickLevels(together, False, np.array(entries, np.int32), numbers)


class Segments(NamedTuple):
    """Samples of rays, ray by ray. Consecutive samples of a ray in the same brick form a segment."""

    points: np.ndarray
    """[n_samples, 3] float32 places, in cells of the densities' grid."""
    weights: np.ndarray
    """[n_samples] float32 compositing weights."""
    left: np.ndarray
    """[n_samples] float64: the transmittance T in front of each sample."""
    ray: np.ndarray
    """[n_samples] int64: the ray of each sample."""


def samples_of(grid: SparseGrid, rays: TeacherRays) -> Iterator[Segments]:
    """Yield the samples with weight of the rays, in batches of rays."""
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


def heavy_vertices(levels: BrickLevels, n: int, rays: TeacherRays) -> np.ndarray:
    """Return [n] float32 above 0: for each vertex of the finest level, the summed weights of the samples
    around it, plus a little, so that vertices that no ray sees are not 0."""
    grid, totals = levels.at(0), np.zeros(n, np.float32)
    for samples in samples_of(grid, rays):
        rows, shares = corners(grid.rows, samples.points * grid.feature_scale, MIN_TOTAL)
        add_corner_weights(rows, shares, samples.weights, totals)
    return totals + np.float32(max(1e-2 * float(totals.mean()), 1e-6))


def feature_errors(levels: BrickLevels, rays: TeacherRays) -> np.ndarray:
    """Return [n_levels, n_bricks] float64: the error by showing each level in each brick of the finest level;
    0 for the finest level itself."""
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


def density_errors(levels: BrickLevels, rays: TeacherRays) -> np.ndarray:
    """Return [n_levels, n_bricks] float64: the errors of the densities, as `feature_errors` those of the
    features."""
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
            # A ray's samples in a brick are consecutive: add up their depths before anything is sorted.
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
