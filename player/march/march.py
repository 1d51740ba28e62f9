"""The march through the sparse grid, in numpy: the statement of what every player computes.

Letters: (o, d) a ray in the model frame, d of unit length; dt the step; tau the optical depth so far; A the
    opacity.

1. The ray enters the box at t_in (0 if it starts inside) and leaves at t_out. Its samples are at the lattice
   `t_n = t_in + (n + 1/2) dt`, n = 0, 1, ..., while t_n < t_out. The lattice depends on the ray alone, so
   skipping what is empty never changes a picture.
2. A sample in a cell that is not live contributes nothing. Otherwise sigma is decoded from the interpolated
   code (`player.asset.density`), and `alpha = -expm1(-sigma dt)`, `w = exp(-tau) alpha`, `tau += sigma dt`.
   The march stops after the sample with `exp(-tau) < 1e-3`. `A = 1 - exp(-tau)`.
3. Features are fetched at k places only (`player.march.fetches`), and the head runs once on their
   weighted sum.

What decides which cell a sample is in is float32 and in grid coordinates (cells): the entry point e,
clamped into the box, and `g = e + s d` with `s = (n + 1/2) dt`. `player.compiled.march` does the same
operations in the same order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.asset.grid import SparseGrid
from player.march.box import Entries, enter_box
from player.march.fetches import Samples, fetch_features

MAX_TAU = np.float32(-np.log(1e-3))
"""The march stops behind this optical depth, where a thousandth of the light is left: a quarter of an 8-bit
level."""

MIN_OPACITY = np.float32(1 / 512)
"""Rays below this opacity are not shaded: they could not change an 8-bit value by more than half a
level."""

SKIP_MARGIN = np.float32(0.01)
"""Cells by which a jump stays inside what is known to be empty: a hundred times the rounding of a grid
coordinate."""

CHUNK = 8
"""Lattice samples that a ray evaluates at a time near a surface: fewer calls of numpy, few samples in
vain."""


class MarchResult(NamedTuple):
    """What a march returns for n rays, n_hits of which have an opacity over MIN_OPACITY."""

    opacity: np.ndarray
    """[n] float32, 0..1."""
    depth: np.ndarray
    """[n] float32, mean t of the weights, model units; 0 where nothing was met."""
    n_density_samples: np.ndarray
    """[n] int32, density samples taken in live cells."""
    hits: np.ndarray
    """[n_hits] int64, the rays that have features, ascending."""
    features: np.ndarray
    """[n_hits, n_channels] float32, in units of the codes."""


def march(
    grid: SparseGrid,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    n_fetches: int,
    bounds: tuple[np.ndarray, np.ndarray] | None = None,
) -> MarchResult:
    """March rays and fetch their features.

    Args:
        grid: the sparse grid.
        rays_o: [n, 3] float32 origins, model frame.
        rays_d: [n, 3] float32 unit directions, model frame.
        n_fetches: k, feature fetches a ray; 0 fetches at every sample.
        bounds: optional [n] float32 `near` and `far`: t outside which the caller knows that there is no
            live cell.
    """
    n_rays = len(rays_o)
    entries = enter_box(grid, rays_o, rays_d)
    samples, tau, counts = collect_samples(grid, entries, bounds)
    opacity = -np.expm1(-tau)
    heavy = samples.weights.astype(np.float64)
    total = np.bincount(samples.ray, heavy, n_rays)
    moment = np.bincount(samples.ray, heavy * samples.s, n_rays)
    met = total > 0
    depth = np.where(met, entries.t + (moment / np.where(met, total, 1)).astype(np.float32), np.float32(0))
    hits = np.flatnonzero(opacity > MIN_OPACITY)
    features = fetch_features(grid, entries, samples, opacity, hits, n_fetches)
    return MarchResult(opacity, depth, counts, hits, features)


def collect_samples(
    grid: SparseGrid, entries: Entries, bounds: tuple[np.ndarray, np.ndarray] | None
) -> tuple[Samples, np.ndarray, np.ndarray]:
    """The samples of rays, all of them in step: a ray in an empty brick jumps, a ray in another takes a chunk
    of the lattice.

    Returns the samples, and for each ray tau and the number of samples taken.
    """
    n_rays = len(entries.t)
    tau = np.zeros(n_rays, np.float32)
    longest = np.float32(grid.most_samples - 1) * grid.step
    first, length = np.zeros(n_rays, np.int32), np.minimum(entries.length, longest)
    if bounds is not None:
        ahead = np.maximum(bounds[0] - entries.t, 0) / grid.step - np.float32(0.5)
        first = np.maximum(np.floor(np.minimum(ahead, np.float32(1e9))), 0).astype(np.int32)
        length = np.minimum(length, bounds[1] - entries.t)
    rays = np.flatnonzero(length > (first + np.float32(0.5)) * grid.step)
    state = (rays, first[rays], length[rays], entries.point[:, rays], entries.direction[:, rays])
    parts: list[tuple[np.ndarray, ...]] = []
    while len(state[0]):
        rays, i, length, point, direction = state
        bricks, slot = _locate(grid, point, direction, i)
        busy = np.flatnonzero(slot >= 0)
        empty = np.flatnonzero(slot < 0)
        if len(empty):
            i[empty] = np.maximum(
                i[empty] + 1,
                _jump(grid, point[:, empty], direction[:, empty], bricks[:, empty], -1 - slot[empty]),
            )
        if len(busy):
            parts.append(_take_chunk(grid, [a[..., busy] for a in state], tau))
            i[busy] += CHUNK
        alive = ((i + np.float32(0.5)) * grid.step < length) & ~(tau[rays] > MAX_TAU)
        if not alive.all():
            keep = np.flatnonzero(alive)
            state = tuple(a[..., keep] for a in state)
    return weigh(parts, tau, n_rays)


def _locate(
    grid: SparseGrid, point: np.ndarray, direction: np.ndarray, i: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Brick coordinate [3, n] and table entry [n] of each ray's lattice sample i."""
    s = (i + np.float32(0.5)) * grid.step
    bricks = (point + s * direction).astype(np.int32)
    np.clip(bricks, 0, grid.resolution - 1, out=bricks)
    bricks >>= 3
    n = np.int32(grid.n_per_axis)
    return bricks, grid.table.take((bricks[0] * n + bricks[1]) * n + bricks[2])


def _jump(
    grid: SparseGrid, point: np.ndarray, direction: np.ndarray, bricks: np.ndarray, reach: np.ndarray
) -> np.ndarray:
    """First lattice index at which a ray may have left the bricks within `reach` of its own."""
    forward = direction > 0
    face = np.where(forward, (bricks + (reach + 1)) * 8 - SKIP_MARGIN, (bricks - reach) * 8 + SKIP_MARGIN)
    still = direction == 0
    s = (face.astype(np.float32) - point) / np.where(still, np.float32(1), direction)
    s[still] = np.inf
    nearest = np.minimum(s.min(axis=0), np.float32(1e6))
    return np.floor(np.minimum(nearest / grid.step - np.float32(0.5), np.float32(1e9))).astype(np.int32) + 1


def _take_chunk(grid: SparseGrid, state: list[np.ndarray], tau: np.ndarray) -> tuple[np.ndarray, ...]:
    """CHUNK lattice samples of each ray: those in live cells, up to the one that passes MAX_TAU; `tau` is
    updated.

    Returns what `accumulate` does.
    """
    rays, i, length, point, direction = state
    s = ((i[:, None] + np.arange(CHUNK, dtype=np.int32)) + np.float32(0.5)) * grid.step  # [n, CHUNK]
    flat = np.zeros(s.shape, np.int32)
    byte, corner = np.zeros(s.shape, np.int32), np.zeros(s.shape, np.int32)
    fractions = []
    for axis in range(3):
        g = point[axis][:, None] + s * direction[axis][:, None]
        cell = g.astype(np.int32)
        np.clip(cell, 0, grid.resolution - 1, out=cell)
        fractions.append((g, cell))
        flat = flat * np.int32(grid.n_per_axis) + (cell >> 3)
        local = cell & 7
        corner = corner * np.int32(9) + local
        byte = byte * np.int32(8) + local
    slot = grid.table.take(flat)
    known = np.maximum(slot, 0)
    bits = grid.live.take(known * np.int32(64) + (byte >> 3)) >> (byte & 7).astype(np.uint8)
    is_live = ((bits & 1) != 0) & (slot >= 0) & (s < length[:, None])
    at = np.flatnonzero(is_live)
    f = [g.reshape(-1)[at] - cell.reshape(-1)[at] for g, cell in fractions]
    where = known.reshape(-1)[at].astype(np.int64) * 729 + corner.reshape(-1)[at]
    code = trilinear(grid.density, where, [x.astype(np.float32) for x in f])
    optical = np.exp(grid.density_low + grid.density_slope * code) * grid.step
    return accumulate(rays, s, at, optical, tau)


def accumulate(
    rays: np.ndarray, s: np.ndarray, at: np.ndarray, optical: np.ndarray, tau: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Add the optical depths of a chunk's samples to `tau` [n_all], for each ray up to the one that passes
    MAX_TAU.

    Args:
        rays: [n] the rays of the chunk, each once.
        s: [n, chunk] float32 of their lattice samples.
        at: [m] which of these count, as flat indices, ascending.
        optical: [m] float32 their optical depths.
        tau: updated.

    Returns of every sample taken its ray, s, optical depth, and tau before it.
    """
    row, column = np.divmod(at, s.shape[1])
    added = np.zeros((len(rays), s.shape[1] + 1), np.float32)
    added[:, 0] = tau[rays]
    added[row, column + 1] = optical
    running = np.cumsum(added, axis=1, dtype=np.float32)
    before = running[row, column]
    kept = before <= MAX_TAU
    row, column = row[kept], column[kept]
    tau[rays[row]] = running[row, column + 1]  # in order, so that the last sample of each ray stays
    return rays[row], s[row, column], optical[kept], before[kept]


def trilinear(density: np.ndarray, at: np.ndarray, f: list[np.ndarray]) -> np.ndarray:
    """Codes between the corners of cells: along z, then y, then x."""

    def lerp(a: np.ndarray, b: np.ndarray, x: np.ndarray) -> np.ndarray:
        return a + (b - a) * x

    def edge(offset: int) -> np.ndarray:
        a = density.take(at + offset).astype(np.float32)
        b = density.take(at + (offset + 1)).astype(np.float32)
        return lerp(a, b, f[2])

    return lerp(lerp(edge(0), edge(9), f[1]), lerp(edge(81), edge(90), f[1]), f[0])


def weigh(
    parts: list[tuple[np.ndarray, ...]], tau: np.ndarray, n_rays: int
) -> tuple[Samples, np.ndarray, np.ndarray]:
    """Samples of all rounds, sorted by ray, with their weights; those without weight are dropped."""
    if not parts:
        none = np.zeros(0, np.float32)
        return Samples(none.astype(np.int64), none, none), tau, np.zeros(n_rays, np.int32)
    ray, s, optical, before = (np.concatenate(column) for column in zip(*parts, strict=True))
    counts = np.bincount(ray, minlength=n_rays).astype(np.int32)
    small = ray.astype(np.uint16) if n_rays <= 1 << 16 else ray  # 16 bits are sorted by radix
    order = np.argsort(small, kind="stable")
    weights = (np.exp(-before) * -np.expm1(-optical))[order]
    samples = Samples(ray[order], s[order], weights)
    if (weights > 0).all():
        return samples, tau, counts
    kept = np.flatnonzero(weights > 0)
    return Samples(*(column[kept] for column in samples)), tau, counts
