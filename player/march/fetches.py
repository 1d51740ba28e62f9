"""Choice of where along a ray features are fetched (looked up): at k positions instead of at every sample.

Notation: a ray has m samples at s_i with weights w_i, and opacity A. Its weights are cut into k bins of equal
mass; a sample may be split between bins. Features are fetched once for each bin, at the centroid of its mass
and with the weight A / k, so that the weights still add up to A and opacity does not depend on k. On a ray
with m <= k samples, features are fetched at exactly these samples.

Features are interpolated trilinearly over the corners that are stored, and divided by the sum of the
interpolation weights of these corners. A bin that straddles a gap may have its centroid where nothing is
stored: if that sum is below MIN_TOTAL, the bin is fetched at its heaviest sample instead (the first of
equals), which lies in a live cell.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from player.asset.grid import CELLS_OF_LEVELS, SparseGrid, brick_number, corner_number
from player.march.path import Path

MIN_TOTAL = np.float32(1e-3)
"""Least sum of the interpolation weights of stored corners with which a point counts as stored."""

CORNERS = np.array([x * 81 + y * 9 + z for x, y, z in np.ndindex(2, 2, 2)])
"""Places of the corners of a cell in a brick with an apron, relative to the lowest corner."""

BLOCK = 8192
"""Fetches that are processed at a time: more need fewer calls of numpy, fewer stay in the caches."""


class Samples(NamedTuple):
    """Samples with weight, grouped by ray, in the order of the march."""

    ray: np.ndarray
    """[n_samples] int64, the ray of each sample."""
    s: np.ndarray
    """[n_samples] positions on the rays: distances from the entry in a box, model units; angles in contracted
    space."""
    weights: np.ndarray
    """[n_samples] float32, compositing weights."""


class Bins(NamedTuple):
    """The k bins of n rays that have more than k samples each; bin j of ray r is row r * k + j."""

    ray: np.ndarray
    """[n * k] int64, the ray of each bin."""
    s: np.ndarray
    """[n * k] float32, centroid of the bin's mass."""
    first: np.ndarray
    """[n * k] int64, the first sample with mass in the bin."""
    last: np.ndarray
    """[n * k] int64, the last sample with mass in the bin."""
    start: np.ndarray
    """[n * k] float64, mass of the ray before the bin, 0..1."""
    mass: np.ndarray
    """[n_samples] float64, mass of the ray up to and including each sample, 0..1."""
    k: int
    """Bins per ray; each has the mass 1 / k."""


def fetch_features(
    grid: SparseGrid, path: Path, samples: Samples, opacity: np.ndarray, hits: np.ndarray, k: int
) -> np.ndarray:
    """Return the sum of weight times feature over the fetches of each ray in `hits`: [n_hits, n_channels]
    float32.

    Args:
        grid: the sparse grid.
        path: the path of all rays.
        samples: all samples with weight.
        opacity: [n] float32 of all rays.
        hits: [n_hits] rays to fetch for, ascending.
        k: fetches per ray; 0 fetches at every sample.
    """
    rows = np.full(len(opacity), -1, np.int64)
    rows[hits] = np.arange(len(hits))
    out = np.zeros((len(hits), grid.n_channels), np.float32)
    counts = np.bincount(samples.ray, minlength=len(opacity))
    wanted = rows[samples.ray] >= 0
    merged = wanted & (counts[samples.ray] > k) if k else np.zeros(len(wanted), bool)
    own = Samples(*(column[wanted & ~merged] for column in samples))
    _add(grid, path, own, rows, out)
    if merged.any():
        samples = Samples(*(column[merged] for column in samples))
        bins = equal_mass_bins(samples, k)
        weights = opacity[bins.ray] / np.float32(k)
        gaps = _add(grid, path, Samples(bins.ray, bins.s, weights), rows, out)
        if len(gaps):
            s = samples.s[heaviest(bins, gaps)]
            _add(grid, path, Samples(bins.ray[gaps], s, weights[gaps]), rows, out)
    return out


def equal_mass_bins(samples: Samples, k: int) -> Bins:
    """Cut the weights of each ray into k bins of equal mass; every ray has more than k samples.

    The cumulative mass of each ray is scaled to end at 1, so that `rank + mass` rises over all rays and one
    search finds every cut.

    >>> samples = Samples(np.zeros(3, int), np.float32([1, 2, 4]), np.float32([0.25, 0.25, 0.25]))
    >>> equal_mass_bins(samples, 2).s.round(3).tolist()
    [1.3329999446868896, 3.3329999446868896]
    """
    starts = np.flatnonzero(np.diff(samples.ray, prepend=-1))
    ends = np.append(starts[1:], len(samples.ray)) - 1
    rank = np.repeat(np.arange(len(starts)), ends - starts + 1)
    weights = samples.weights.astype(np.float64)
    share = weights / np.add.reduceat(weights, starts)[rank]
    unit = samples.s[ends].astype(np.float64)  # the last sample's s, so that moments are at most 1 too
    mass = _cumulative(share, starts, rank)
    mass /= mass[ends][rank]
    moment = _cumulative(share * (samples.s / unit[rank]), starts, rank)
    cuts = np.arange(1, k) / k
    found = np.searchsorted(rank + mass, np.arange(len(starts))[:, None] + cuts)
    found = np.clip(found, starts[:, None], ends[:, None])
    at_cut = moment[found] - (mass[found] - cuts) * (samples.s[found] / unit[:, None])
    edges = np.concatenate([np.zeros((len(starts), 1)), at_cut, moment[ends][:, None]], axis=1)
    centroids = np.diff(edges, axis=1) * k * unit[:, None]
    return Bins(
        ray=np.repeat(samples.ray[starts], k),
        s=centroids.reshape(-1).astype(np.float32),
        first=np.concatenate([starts[:, None], found], axis=1).reshape(-1),
        last=np.concatenate([found, ends[:, None]], axis=1).reshape(-1),
        start=np.tile(np.arange(k) / k, len(starts)),
        mass=mass,
        k=k,
    )


def _cumulative(values: np.ndarray, starts: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """Return running sums of values 0..1 along each ray, the sample itself included.

    Values are summed as integer multiples of 2^-50, whose sums are exact even where they wrap around: a ray's
    sums must not depend on the rays before it.
    """
    whole = np.rint(values * 2.0**50).astype(np.int64)
    running = np.cumsum(whole)
    return (running - (running[starts] - whole[starts])[rank]) * 2.0**-50


def heaviest(bins: Bins, which: np.ndarray) -> np.ndarray:
    """Return, for each of the bins `which` [n], the sample [n] that has the most mass inside it; the first of
    equals.

    >>> samples = Samples(np.zeros(3, int), np.float32([1, 2, 4]), np.float32([0.3, 0.4, 0.3]))
    >>> heaviest(equal_mass_bins(samples, 2), np.array([0, 1])).tolist()
    [0, 2]
    """
    first, begin = bins.first[which], bins.start[which]
    counts = bins.last[which] - first + 1
    starts = np.cumsum(counts) - counts
    owner = np.repeat(np.arange(len(which)), counts)
    index = np.arange(counts.sum()) - starts[owner] + first[owner]
    before = np.where(index == first[owner], begin[owner], bins.mass[index - 1])
    inside = np.minimum(bins.mass[index], begin[owner] + 1 / bins.k) - before
    most = np.maximum.reduceat(inside, starts)[owner]
    candidates = np.flatnonzero(inside >= most)
    _, place = np.unique(owner[candidates], return_index=True)
    return index[candidates[place]]


def _add(grid: SparseGrid, path: Path, fetches: Samples, rows: np.ndarray, out: np.ndarray) -> np.ndarray:
    """Add each fetch to its ray's row of `out`; returns the indices of the fetches where too little is
    stored."""
    gaps = []
    firsts = np.flatnonzero(np.diff(fetches.ray, prepend=-1))
    cuts = np.searchsorted(
        firsts, np.arange(0, len(fetches.ray), BLOCK)
    )  # no ray is cut, so that its sum keeps its order
    edges = np.unique(np.append(firsts[cuts[cuts < len(firsts)]], len(fetches.ray)))
    for start, stop in itertools.pairwise(edges):
        ray, s, weights = (column[start:stop] for column in fetches)
        values, total = stored_features(grid, path.at(ray, s))
        poor = total < MIN_TOTAL
        scale = np.where(poor, np.float32(0), weights / np.where(poor, np.float32(1), total))
        values *= scale[:, None]
        groups = np.flatnonzero(np.diff(ray, prepend=-1))
        out[rows[ray[groups]]] += np.add.reduceat(values, groups, axis=0)
        gaps.append(start + np.flatnonzero(poor))
    return np.concatenate(gaps) if gaps else np.zeros(0, np.int64)


def stored_features(grid: SparseGrid, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate the features that are stored around points.

    Args:
        grid: the sparse grid.
        g: [3, n] float32, the points, in cells of the densities' grid.

    Returns:
        values: [n, n_channels] float32, the sum of the codes at the corners that are stored, each times its
            trilinear weight.
        total: [n] float32, the sum of these weights, 0..1.
    """
    vertices = grid.rows
    g = np.clip(g * grid.feature_scale, np.float32(0), np.float32(vertices.resolution))
    low = np.minimum(g.astype(np.int32), vertices.resolution - 1)
    held = vertices.bricks.take(brick_number(low, vertices.n_per_axis))
    level = np.maximum(held, 0) & 7
    low >>= level
    fraction = g * CELLS_OF_LEVELS.take(level) - low.astype(np.float32)
    near = corner_number(held >> 3, low) + CORNERS[:, None]
    rows = np.where(held >= 0, vertices.rows.take(near), -1)
    (x0, y0, z0), (x1, y1, z1) = np.float32(1) - fraction, fraction
    edges = [x0 * y0, x0 * y1, x1 * y0, x1 * y1]
    values = np.zeros((g.shape[1], grid.n_channels), np.float32)
    total = np.zeros(g.shape[1], np.float32)
    for corner, row in enumerate(rows):
        weight = edges[corner >> 1] * (z1 if corner & 1 else z0) * (row >= 0)
        values += weight[:, None] * grid.features.take(row, axis=0, mode="clip")
        total += weight
    return values, total
