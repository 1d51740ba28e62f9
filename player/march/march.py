"""The march through the sparse grid, in numpy: the definition of what every player computes.

Notation: (o, d) is a ray in the model frame, d of unit length; tau is the optical depth so far; A is the
opacity.

1. The path of a ray (`player.march.path`) is cut into base steps n = 0, 1, ... In a box a step is a distance
   dt: the ray enters the box at t_in (0 if it starts inside) and leaves at t_out, and the middle of step n is
   at `t_in + (n + 1/2) dt`; the last step is the last whose middle is before t_out. In contracted space
   (`player.march.contracted`) a step is an angle, and the last is almost infinitely far away.
   Where no level has a brick at the middle of step n, the march goes on with step n + 1. Otherwise a sample
   stands for the steps n to n + m - 1, where m is the largest power of two that divides n and is at most
   `level_steps` of the finest level that has a brick there; the sample is at the middle of these steps, and
   the march goes on with step n + m. The path also gives the length l_i of ray, in model units, that sample i
   stands for.
2. A sample in a cell that is not live contributes nothing. Otherwise sigma is decoded from the interpolated
   code (`player.asset.density`), and `alpha = -expm1(-sigma l_i)`, `w = exp(-tau) alpha`, `tau += sigma l_i`.
   The march stops after the sample with `exp(-tau) < 1e-3`. `A = 1 - exp(-tau)`. The depth is t at the
   weighted mean of the samples' positions s. In contracted space these are angles, so that a thousandth of
   the sky shining past a leaf does not move the leaf.
3. Features are fetched at k positions only (`player.march.fetches`), and the head runs once, on their
   weighted sum.

The cell of a sample is found from grid coordinates (cells) in float32, by operations that
`player.compiled.packets` does in the same order. In a box, these coordinates are `g = e + s d`, with the
entry point e, clamped into the box, and `s = (i + 1/2) dt`. In contracted space, `ContractedPath` computes
them from the ray's p, w d, cos(phi_0) and sin(phi_0) and from the lattice's table of cos(s_i) and sin(s_i).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from player.asset.grid import MAX_DISTANCE, LocatedPoints, SparseGrid
from player.march.box import Bounds
from player.march.fetches import Samples, fetch_features
from player.march.path import Path, path_of

OPAQUE_DEPTH = float(-np.log(1e-3))
"""The optical depth at which a ray stops, where a thousandth of the light is left: a quarter of an 8-bit
level."""
MAX_TAU = np.float32(OPAQUE_DEPTH)
"""OPAQUE_DEPTH in float32, as marches compare with it."""

MIN_OPACITY = np.float32(1 / 512)
"""Rays below this opacity are not shaded: they could not change an 8-bit value by more than half a
level."""

CHUNK = np.arange(8, dtype=np.int32)
"""Numbers, from 0 on, of the base steps that a ray evaluates at a time near a surface: enough for few calls
of numpy, and few enough that not many samples are evaluated in vain."""


class MarchResult(NamedTuple):
    """The result of a march of n rays, n_hits of which have an opacity over MIN_OPACITY."""

    opacity: np.ndarray
    """[n] float32, 0..1."""
    depth: np.ndarray
    """[n] float32, t at the weighted mean position of the samples, model units; 0 where nothing was met."""
    n_density_samples: np.ndarray
    """[n] int32, density samples taken in live cells."""
    hits: np.ndarray
    """[n_hits] int64, indices of the rays that have features, ascending."""
    features: np.ndarray
    """[n_hits, n_channels] float32, in units of the codes."""


def march(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    n_fetches: int,
    bounds: Bounds | None = None,
    opaque_depth: np.float32 = MAX_TAU,
) -> MarchResult:
    """March rays and fetch their features.

    Args:
        grid: the sparse grid.
        rays_o: [n, 3] float32 origins, model frame.
        rays_d: [n, 3] float32 unit directions, model frame.
        n_fetches: k, feature lookups per ray; 0 looks features up at every sample.
        bounds: bounds of t between which live cells of a box can be, if they are known.
        opaque_depth: the optical depth at which rays stop. If that is below MAX_TAU, the sample that passes
            it counts as opaque, so that what is left of the light is not lost.
    """
    path, samples, _, tau, counts = sample_rays(grid, rays_o, rays_d, bounds, opaque_depth)
    n_rays = len(rays_o)
    opacity = -np.expm1(-tau)
    heavy = samples.weights.astype(np.float64)
    total = np.bincount(samples.ray, heavy, n_rays)
    moment = np.bincount(samples.ray, heavy * samples.s, n_rays)
    met = total > 0
    mean = (moment / np.where(met, total, 1)).astype(np.float32)
    depth = np.where(met, path.distances(np.arange(n_rays), mean), np.float32(0))
    hits = np.flatnonzero(opacity > MIN_OPACITY)
    features = fetch_features(grid, path, samples, opacity, hits, n_fetches)
    return MarchResult(opacity, depth, counts, hits, features)


class SampledRays(NamedTuple):
    """n rays and their samples."""

    path: Path
    samples: Samples
    """All samples with weight."""
    ways: np.ndarray
    """[n_samples] float32, the length of ray, in model units, that each sample stands for."""
    tau: np.ndarray
    """[n] float32, optical depth."""
    n_density_samples: np.ndarray
    """[n] int32, density samples taken in live cells."""


def sample_rays(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    bounds: Bounds | None = None,
    opaque_depth: np.float32 = MAX_TAU,
) -> SampledRays:
    """Find the samples of rays; the arguments are those of `march`.

    All rays are marched together. In each round, a ray in no brick jumps, and a ray in a brick takes a chunk
    of its samples.
    """
    path = path_of(grid, rays_o, rays_d, bounds)
    tau = np.zeros(len(rays_o), np.float32)
    ray, i = np.arange(len(rays_o)), path.first
    chunks: list[Taken] = []
    while True:
        alive = np.flatnonzero((path.sample(i) < path.length[ray]) & ~(tau[ray] > opaque_depth))
        if not len(alive):
            return SampledRays(path, *_weigh(chunks, tau))
        ray, i = ray[alive], i[alive]
        g = path.place(ray, i)
        cells = grid.cells(g)
        entries = grid.entries(cells)
        busy = entries >= 0
        empty = np.flatnonzero(~busy)
        if len(empty):
            brick, reach = cells[:, empty] >> 3, (-entries[empty] & MAX_DISTANCE) - 1
            there = path.jump(ray[empty], i[empty], g[:, empty], brick, reach)
            after = i[empty] + group_size(grid, i[empty], entries[empty])
            busy[empty] = after > there  # the sample's middle may be in a live cell
            i[empty] = np.where(
                busy[empty], i[empty], np.maximum(there & -grid.most_steps, after)
            )  # a step that every march visits
        busy = np.flatnonzero(busy)
        if len(busy):
            chunk = _chunk(grid, path, ray[busy], i[busy])
            chunks.append(_take(grid, path, ray[busy], chunk, tau, opaque_depth))
            i[busy] = chunk.after


class Chunk(NamedTuple):
    """Samples of n rays that may be in live cells: each ray's samples are in the order of the march."""

    column: np.ndarray
    """[n_samples] int64: the base step with which each sample begins, as an index into CHUNK."""
    row: np.ndarray
    """[n_samples] int64: the ray of each sample, as an index into the n rays."""
    i: np.ndarray
    """[n_samples] int32: the number of this base step on the sample's ray."""
    size: np.ndarray
    """[n_samples] int32: the number of base steps that each sample stands for."""
    s: np.ndarray
    """[n_samples] float32: positions on the rays."""
    found: LocatedPoints
    """The cells that the samples are in."""
    after: np.ndarray
    """[n] int32: the base step with which each ray goes on after the chunk."""


def _chunk(grid: SparseGrid, path: Path, ray: np.ndarray, i: np.ndarray) -> Chunk:
    """Find the samples that begin in the len(CHUNK) base steps of each ray from `i` [n] on."""
    steps = i + CHUNK[:, None]
    entries = grid.entries(grid.cells(path.place(ray[None], steps)))
    sizes = group_size(grid, steps, entries)
    begins, after = np.empty(steps.shape, bool), i
    for here, size, entry, begin in zip(steps, sizes, entries, begins, strict=True):
        at = after == here
        np.logical_and(at, (entry >= 0) | (size > 1), out=begin)
        after = np.where(at, here + size, after)
    chosen = np.flatnonzero(begins)
    column, row = np.divmod(chosen, len(ray))
    i, size = steps.reshape(-1)[chosen], sizes.reshape(-1)[chosen]
    found = grid.find(path.place(ray[row], i, size))
    return Chunk(column, row, i, size, path.sample(i, size), found, after)


def group_size(grid: SparseGrid, i: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """Return the number of base steps that samples stand for which begin with steps `i`, where the table has
    `entries` at the middles of these steps. It is the largest power of two that divides i and is at most the
    level's `level_steps`; 1 where there is no brick."""
    most = grid.steps_at(entries)
    return np.where(i == 0, most, np.minimum(most, i & -i)).astype(np.int32)


class Taken(NamedTuple):
    """Samples in live cells that were taken."""

    ray: np.ndarray
    """[n_samples] int64."""
    s: np.ndarray
    """[n_samples] positions on the rays."""
    way: np.ndarray
    """[n_samples] float32, the length of ray, in model units, that the sample stands for."""
    optical: np.ndarray
    """[n_samples] float32, the sample's optical depth."""
    before: np.ndarray
    """[n_samples] float32, tau before the sample."""


def _take(
    grid: SparseGrid,
    path: Path,
    ray: np.ndarray,
    chunk: Chunk,
    tau: np.ndarray,
    opaque_depth: np.float32,
) -> Taken:
    """Take those samples of a chunk of the rays `ray` [n] that are in live cells, up to the sample that
    passes `opaque_depth`. That sample counts as opaque if `opaque_depth` is below MAX_TAU. `tau` [n_rays] is
    updated."""
    at = np.flatnonzero(chunk.found.live & (chunk.s < path.length[ray][chunk.row]))
    column, row, i, size, s = (array[at] for array in chunk[:5])
    found = LocatedPoints(*(array.take(at, axis=-1) for array in chunk.found))
    code = trilinear(grid.density, found.corners, found.fractions)
    way = path.way(ray[row], i, size)
    optical = np.exp(grid.density_low + grid.density_slope * code) * way
    running = np.zeros((len(CHUNK) + 1, len(ray)), np.float32)
    running[0] = tau[ray]
    running[column + 1, row] = optical
    for above, here in itertools.pairwise(running):
        here += above
    before = running[column, row]
    kept = before <= opaque_depth
    row, column, optical = row[kept], column[kept], optical[kept]
    after = running[column + 1, row]
    if opaque_depth < MAX_TAU:
        last = after > opaque_depth
        after[last] = optical[last] = np.inf
    tau[ray[row]] = after  # in order: the value of each ray's last sample stays
    return Taken(ray[row], s[kept], way[kept], optical, before[kept])


def trilinear(density: np.ndarray, corner: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Interpolate codes [n] in cells trilinearly: along z, then y, then x.

    Args:
        density: codes of bricks with an apron.
        corner: [n] index into `density` of the lowest corner of each cell.
        fraction: [3, n] float32 positions in the cells, 0..1.
    """

    def lerp(a: np.ndarray, b: np.ndarray, x: np.ndarray) -> np.ndarray:
        return a + (b - a) * x

    def edge(offset: int) -> np.ndarray:
        a = density.take(corner + offset).astype(np.float32)
        b = density.take(corner + (offset + 1)).astype(np.float32)
        return lerp(a, b, fraction[2])

    return lerp(lerp(edge(0), edge(9), fraction[1]), lerp(edge(81), edge(90), fraction[1]), fraction[0])


def _weigh(chunks: list[Taken], tau: np.ndarray) -> tuple[Samples, np.ndarray, np.ndarray, np.ndarray]:
    """Join the samples of all chunks, sorted by ray, and compute their weights; samples without weight are
    dropped. Returns the samples, the lengths that they stand for, tau, and the number of samples taken on
    each ray."""
    n_rays = len(tau)
    if not chunks:
        none = np.zeros(0, np.float32)
        return Samples(none.astype(np.int64), none, none), none, tau, np.zeros(n_rays, np.int32)
    ray, s, ways, optical, before = (np.concatenate(column) for column in zip(*chunks, strict=True))
    counts = np.bincount(ray, minlength=n_rays).astype(np.int32)
    small = ray.astype(np.uint16) if n_rays <= 1 << 16 else ray  # numpy sorts 16 bits by radix
    order = np.argsort(small, kind="stable")
    weights = (np.exp(-before) * -np.expm1(-optical))[order]
    samples = Samples(ray[order], s[order], weights)
    if (weights > 0).all():
        return samples, ways[order], tau, counts
    kept = np.flatnonzero(weights > 0)
    return Samples(*(column[kept] for column in samples)), ways[order[kept]], tau, counts
