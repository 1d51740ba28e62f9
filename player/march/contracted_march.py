"""The march through contracted space, in numpy: the statement of what every player computes for a scene
without end.

As `player.march.march`, with the letters and the lattice of `player.march.contracted`: a sample at phi in a
live cell adds sigma times its way in model units to the optical depth, and rays end where that passes MAX_TAU
or phi is almost pi/2. A fetch is placed by s, the angle. `depth` is t at the mean s of the weights, and not
the mean t: a thousandth of the sky shining past a leaf does not move the leaf.

What decides which cell a sample is in is float32: the ray's p, w d, cos(phi_0) and sin(phi_0), the lattice's
table of cos(s_n) and sin(s_n), and what `ContractedRays.on_grid` does with them.
`player.compiled.contracted_march` does the same operations in the same order.
"""

from __future__ import annotations

import numpy as np

from player.asset.grid import SparseGrid
from player.march.contracted import MAX_SPEED, SPARE, ContractedRays, enter_space, lattice
from player.march.fetches import Samples, fetch_features
from player.march.march import MAX_TAU, MIN_OPACITY, SKIP_MARGIN, MarchResult, accumulate, trilinear, weigh

CHUNK = SPARE
"""Lattice samples that a ray evaluates at a time near a surface."""


def march(
    grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, n_fetches: int, bounds: None = None
) -> MarchResult:
    """`player.march.march.march` through a contracted grid, which has no box that could be missed: no
    `bounds`."""
    rays = enter_space(grid, rays_o, rays_d)
    samples, tau, counts = collect_samples(grid, rays)
    opacity = -np.expm1(-tau)
    heavy = samples.weights.astype(np.float64)
    total = np.bincount(samples.ray, heavy, len(rays_o))
    moment = np.bincount(samples.ray, heavy * samples.s, len(rays_o))
    met = total > 0
    mean = (moment / np.where(met, total, 1)).astype(np.float32)
    depth = np.where(met, rays.distances(np.arange(len(rays_o)), mean), np.float32(0))
    hits = np.flatnonzero(opacity > MIN_OPACITY)
    return MarchResult(
        opacity, depth, counts, hits, fetch_features(grid, rays, samples, opacity, hits, n_fetches)
    )


def collect_samples(grid: SparseGrid, rays: ContractedRays) -> tuple[Samples, np.ndarray, np.ndarray]:
    """The samples of rays, all of them in step; as `player.march.march.collect_samples`."""
    n_rays = len(rays.length)
    tau = np.zeros(n_rays, np.float32)
    table = lattice(float(grid.step))
    index = np.flatnonzero(rays.length > table[0, 0])
    i = np.zeros(len(index), np.int64)
    parts: list[tuple[np.ndarray, ...]] = []
    while len(index):
        g = rays.on_grid(index, *rays.lattice_turned(index, *table[1:, i]))
        bricks = np.clip(g.astype(np.int32), 0, grid.resolution - 1) >> 3
        n = np.int32(grid.n_per_axis)
        slot = grid.table.take((bricks[0] * n + bricks[1]) * n + bricks[2])
        busy, empty = np.flatnonzero(slot >= 0), np.flatnonzero(slot < 0)
        if len(empty):
            i[empty] += _skip(grid, g[:, empty], bricks[:, empty], -1 - slot[empty])
        if len(busy):
            parts.append(_take_chunk(grid, rays, index[busy], i[busy], table, tau))
            i[busy] += CHUNK
        alive = i < table.shape[1] - SPARE
        alive[alive] = table[0, i[alive]] < rays.length[index[alive]]
        alive &= ~(tau[index] > MAX_TAU)
        index, i = index[alive], i[alive]
    return weigh(parts, tau, n_rays)


def _skip(grid: SparseGrid, g: np.ndarray, bricks: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """By how many samples a ray at g [3, n] may go on, when all bricks within `reach` [n] of its own are
    empty."""
    low, high = ((bricks - reach) * 8).astype(np.float32), ((bricks + reach + 1) * 8).astype(np.float32)
    free = np.minimum(g - low, high - g).min(axis=0) - SKIP_MARGIN
    fastest = MAX_SPEED * grid.step * grid.cells_per_unit[0]
    return np.maximum(np.floor(free / fastest), 0).astype(np.int64) + 1


def _take_chunk(
    grid: SparseGrid,
    rays: ContractedRays,
    index: np.ndarray,
    i: np.ndarray,
    table: np.ndarray,
    tau: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """CHUNK lattice samples of each ray: those in live cells, up to the one that passes MAX_TAU; `tau` is
    updated.

    Returns what `player.march.march.accumulate` does.
    """
    which = (i[:, None] + np.arange(CHUNK)).reshape(-1)
    owner = np.repeat(index, CHUNK)
    s, cos_s, sin_s = table[:, which]
    cos, sin = rays.lattice_turned(owner, cos_s, sin_s)
    g = rays.on_grid(owner, cos, sin)
    is_live, where, fractions = _cells(grid, g)
    at = np.flatnonzero(is_live & (s < rays.length[owner]))
    code = trilinear(grid.density, where[at], [f[at] for f in fractions])
    way = rays.ways(owner[at], cos[at], sin[at])
    optical = np.exp(grid.density_low + grid.density_slope * code) * way
    return accumulate(index, s.reshape(-1, CHUNK), at, optical, tau)


def _cells(grid: SparseGrid, g: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Of places g [3, n]: whether the cell is live [n], its corner in `grid.density` [n], and the place in
    it."""
    cell = np.clip(g.astype(np.int32), 0, grid.resolution - 1)
    brick, local = cell >> 3, cell & 7
    n = np.int32(grid.n_per_axis)
    slot = grid.table.take((brick[0] * n + brick[1]) * n + brick[2])
    known = np.maximum(slot, 0).astype(np.int64)
    bits = grid.live.take(known * 64 + local[0] * 8 + local[1]) >> local[2].astype(np.uint8)
    where = known * 729 + local[0] * 81 + local[1] * 9 + local[2]
    return (
        ((bits & 1) != 0) & (slot >= 0),
        where,
        [g[axis] - cell[axis].astype(np.float32) for axis in range(3)],
    )
