"""Tests of compiled code that returns every sample or fetch of rays, against the march in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from player.asset.grid import SparseGrid
from player.compiled import samples as compiled
from player.march import march
from player.march.fetches import MIN_TOTAL, Samples, equal_mass_bins, heaviest, stored_features
from tests.player.march.contracted_scene import contracted_grid
from tests.player.march.pyramid_scene import random_scene, sparse_scene
from tests.player.march.test_contracted_march import bumps, shells
from tests.player.march.test_levels import rays

GRIDS = {
    "box": lambda: random_scene(60, 50, (1, 2, 4), seed=9).grid,
    "space": lambda: random_scene(60, 50, (1, 2, 4), seed=9, contracted=True).grid,
    "long steps": lambda: sparse_scene((1, 1, 1, 1, 2, 4, 4, 16), 8, contracted=True).grid,
    "haze": lambda: contracted_grid(bumps, lambda x: x[:, 0] < 4),
    "shells": lambda: contracted_grid(bumps, shells),
}


def compare(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray) -> int:
    """Check that both modules find the same samples on these rays; return their number."""
    a, b = (module.sample_rays(grid, rays_o, rays_d) for module in (march, compiled))
    same = a.n_density_samples == b.n_density_samples
    assert (~same).sum() <= 5, "cells are the same but where cosines are rounded differently"
    assert [a.samples.ray.dtype, a.n_density_samples.dtype] == [
        b.samples.ray.dtype,
        b.n_density_samples.dtype,
    ]
    kept_a, kept_b = (same[x.samples.ray] for x in (a, b))
    np.testing.assert_array_equal(a.samples.ray[kept_a], b.samples.ray[kept_b])
    np.testing.assert_array_equal(a.samples.s[kept_a], b.samples.s[kept_b])
    np.testing.assert_allclose(a.samples.weights[kept_a], b.samples.weights[kept_b], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(a.ways[kept_a], b.ways[kept_b], rtol=1e-4)
    np.testing.assert_allclose(a.tau[same], b.tau[same], rtol=1e-4, atol=1e-6)
    at = a.path.at(b.samples.ray, b.samples.s).T
    assert b.points.shape == at.shape == (len(b.samples.s), 3)
    np.testing.assert_allclose(b.points, at, rtol=0, atol=2e-5 * grid.resolution)
    return len(b.samples.s)


@pytest.mark.parametrize("name", GRIDS)
def test_samples_are_those_of_the_march(name: str) -> None:
    assert compare(GRIDS[name](), *rays(3000, seed=1)) > 1000


@pytest.mark.parametrize("n", [0, 1, 17])
def test_any_number_of_rays(n: int) -> None:
    rays_o, rays_d = rays(40, seed=1)
    compare(GRIDS["box"](), rays_o[:n], rays_d[:n])


def test_rays_that_meet_nothing() -> None:
    rays_o, rays_d = (np.float32([[5, 5, 5]] * 20), np.float32([[1, 0, 0]] * 20))
    assert compare(GRIDS["box"](), rays_o, rays_d) == 0


def test_more_samples_than_are_held_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    grid, some = GRIDS["haze"](), rays(1000, seed=2)
    whole = compiled.sample_rays(grid, *some)
    monkeypatch.setattr(compiled, "MOST_AT_ONCE", 1)
    parts = compiled.sample_rays(grid, *some)
    for a, b in zip((*parts.samples, parts.points), (*whole.samples, whole.points), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("n_rays", [0, 1, 17, 1000])
@pytest.mark.parametrize("name", ["box", "space"])
def test_any_number_of_threads_finds_the_same(name: str, n_rays: int) -> None:
    grid, (rays_o, rays_d) = GRIDS[name](), rays(1000, seed=3)
    alone = compiled.sample_rays(grid, rays_o[:n_rays], rays_d[:n_rays])
    for n_threads in (2, 3, 7):
        found = compiled.sample_rays(grid, rays_o[:n_rays], rays_d[:n_rays], n_threads)
        for a, b in zip((*found.samples, *found[1:]), (*alone.samples, *alone[1:]), strict=True):
            assert a.dtype == b.dtype and a.tobytes() == b.tobytes()


def expected_fetches(
    grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ray [n_fetches], the place [n_fetches, 3] and the weight [n_fetches] of each fetch, ray by
    ray, by the functions that define them."""
    path, samples, _, tau, _ = march.sample_rays(grid, rays_o, rays_d)
    opacity = -np.expm1(-tau)
    hit = opacity > march.MIN_OPACITY
    cut = np.bincount(samples.ray, minlength=len(tau))[samples.ray] > k
    own = Samples(*(column[hit[samples.ray] & ~cut] for column in samples))
    merged = Samples(*(column[hit[samples.ray] & cut] for column in samples))
    bins = equal_mass_bins(merged, k)
    gaps = np.flatnonzero(stored_features(grid, path.at(bins.ray, bins.s))[1] < MIN_TOTAL)
    s = bins.s.copy()
    s[gaps] = merged.s[heaviest(bins, gaps)]
    ray = np.concatenate([own.ray, bins.ray])
    weights = np.concatenate([own.weights, opacity[bins.ray] / np.float32(k)])
    order = np.argsort(ray, kind="stable")
    at = path.at(ray, np.concatenate([own.s, s])).T
    return ray[order], at[order], weights[order]


@pytest.mark.parametrize("k", [1, 3, 12])
@pytest.mark.parametrize("name", GRIDS)
def test_fetches_are_those_of_the_definition(name: str, k: int) -> None:
    grid, (rays_o, rays_d) = GRIDS[name](), rays(1000, seed=4)
    ray, at, weights = expected_fetches(grid, rays_o, rays_d, k)
    found = compiled.fetch_places(grid, rays_o, rays_d, k, n_threads=2)
    # Rays of which cosines or optical depths are rounded differently may have other samples.
    n = np.stack([np.bincount(rays_of, minlength=1000) for rays_of in (ray, found.ray)])
    same = n[0] == n[1]
    assert (~same).sum() <= 5 and n.max() == k and (n.max(axis=1) == k).all()
    kept, of_found = same[ray], same[found.ray]
    np.testing.assert_allclose(found.weights[of_found], weights[kept], rtol=2e-4, atol=1e-6)
    far = np.abs(found.points[of_found] - at[kept]).max(axis=1) > 2e-3 * grid.resolution
    assert far.mean() < 1e-3, "but where sums of float32 decide whether a bin has a stored place"
    assert (np.diff(found.ray) >= 0).all()


@pytest.mark.parametrize("n_rays", [0, 1, 17, 1000])
def test_any_number_of_threads_finds_the_same_fetches(n_rays: int) -> None:
    grid, (rays_o, rays_d) = GRIDS["haze"](), rays(1000, seed=3)
    alone = compiled.fetch_places(grid, rays_o[:n_rays], rays_d[:n_rays], 4)
    for n_threads in (2, 3, 7):
        found = compiled.fetch_places(grid, rays_o[:n_rays], rays_d[:n_rays], 4, n_threads)
        for a, b in zip(found, alone, strict=True):
            assert a.dtype == b.dtype and a.tobytes() == b.tobytes()
