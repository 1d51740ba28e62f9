"""Tests of the march through contracted space, against a loop that skips nothing and a closed form."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from player.compiled import march as march_compiled
from player.march import march
from player.march.contracted import enter_space, lattice
from player.march.normals import composited_normals
from tests.numerics.bounds import Row
from tests.player.march.contracted_scene import contracted_grid, dense_codes, naive

MODULES = [march, march_compiled]
CONTRACTED_OPACITY = Row(
    "The two marches", "opacity of one march, against the other, in contracted space",
    "2,000 rays, k = 0, 1, 3, 8", 1e-6, at_ends="the same samples on every ray",
)  # fmt: skip
CONTRACTED_FEATURES = Row(
    "The two marches",
    "features of one march, against the other, in contracted space",
    "the same",
    0.05,
    "codes",
)


def bumps(x: np.ndarray) -> np.ndarray:
    """Return log sigma of a wavy haze everywhere that thins out with the square of the distance."""
    r = np.linalg.norm(x, axis=-1)
    return np.sin(3 * x[:, 0] / np.maximum(r, 1)) + np.cos(2 * x[:, 2] / np.maximum(r, 1)) - 2 * np.log1p(r)


def shells(x: np.ndarray) -> np.ndarray:
    """Return which points are in three shells: inside, across the unit sphere, and far away, with gaps."""
    r = np.linalg.norm(x, axis=-1)
    return (np.abs(r - 0.5) < 0.1) | (np.abs(r - 1) < 0.12) | (np.abs(r - 6) < 3)


def some_rays(n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    rays_o = random.normal(size=(n, 3)) * 10 ** random.uniform(-1.5, 1, (n, 1))
    rays_d = random.normal(size=(n, 3))
    rays_d /= np.linalg.norm(rays_d, axis=-1, keepdims=True)
    return rays_o.astype(np.float32), rays_d.astype(np.float32)


@pytest.mark.parametrize("module", MODULES)
def test_march_is_that_of_a_loop_that_skips_nothing(module: ModuleType) -> None:
    grid, codes = contracted_grid(bumps, shells), dense_codes(bumps, shells)
    assert (grid.table < 0).any(), "there is something to skip"
    rays_o, rays_d = some_rays()
    result = module.march(grid, rays_o, rays_d, 0)
    features = np.zeros((len(rays_o), 4))
    features[result.hits] = result.features
    hit = np.isin(np.arange(len(rays_o)), result.hits)
    for index, (o, d) in enumerate(zip(rays_o, rays_d, strict=True)):
        opacity, depth, taken, composed = naive(grid, codes, o, d)
        assert result.n_density_samples[index] == taken
        assert result.opacity[index] == pytest.approx(opacity, abs=2e-6)
        assert result.depth[index] == pytest.approx(depth, rel=1e-3, abs=1e-5)
        np.testing.assert_allclose(features[index], composed * hit[index], rtol=0, atol=2e-2)
    assert hit.sum() > 30


@pytest.mark.parametrize("module", MODULES)
def test_rays_begin_where_they_are_told(module: ModuleType) -> None:
    """With `near`, rays begin as if the camera stood there; the depth is still counted from the camera."""
    grid, near = contracted_grid(bumps, shells), 0.3
    rays_o, rays_d = some_rays()
    later = module.march(replace(grid, near=near), rays_o, rays_d, 0)
    there = module.march(grid, rays_o + np.float32(near) * rays_d, rays_d, 0)
    np.testing.assert_allclose(later.opacity, there.opacity, atol=2e-5)
    met = there.depth > 0
    assert met.sum() > 30 and (later.depth[met] > near).all()
    np.testing.assert_allclose(later.depth[met], there.depth[met] + near, rtol=1e-3, atol=1e-4)
    assert (module.march(grid, rays_o, rays_d, 0).opacity > later.opacity + 0.1).any()


@pytest.mark.parametrize("k", [0, 1, 3, 8])
def test_the_compiled_march_does_the_same(k: int) -> None:
    grid = contracted_grid(bumps, shells)
    rays = some_rays(2000)
    a, b = (module.march(grid, *rays, k) for module in MODULES)
    np.testing.assert_array_equal(a.n_density_samples, b.n_density_samples)
    np.testing.assert_array_equal(a.hits, b.hits)
    CONTRACTED_OPACITY.check(a.opacity, b.opacity)
    np.testing.assert_allclose(a.depth, b.depth, rtol=1e-3)
    CONTRACTED_FEATURES.check(a.features, b.features)
    np.testing.assert_allclose(a.features[:, 3], 50 * a.opacity[a.hits], rtol=1e-4)


@pytest.mark.parametrize("module", MODULES)
def test_there_is_no_seam_at_the_unit_sphere(module: ModuleType) -> None:
    """The optical depth of a thinning haze is that of its closed form, and jumps nowhere, along rays that
    cross the unit sphere or touch it."""

    def everywhere(x: np.ndarray) -> np.ndarray:
        return np.ones(len(x), bool)

    def haze(x: np.ndarray) -> np.ndarray:
        return -3 * np.log(np.linalg.norm(x, axis=-1) + 1)

    grid = contracted_grid(haze, everywhere)
    b = np.concatenate([np.linspace(0, 2.5, 101), 1 + np.array([-1e-4, -1e-6, 0, 1e-6, 1e-4])])
    rays_o = np.stack([np.full_like(b, -3), b, 0 * b], axis=-1).astype(np.float32)
    rays_d = np.tile(np.float32([1, 0, 0]), (len(b), 1))
    result = module.march(grid, rays_o, rays_d, 0)
    tau = -np.log1p(-result.opacity.astype(np.float64))
    t = 3 * np.tan(np.linspace(0, np.arctan(1000 / 3), 20_001))
    exact = [np.trapezoid((1 + np.hypot(t - 3, offset)) ** -3, t) for offset in b]
    share = tau / exact
    assert np.abs(share - 1).max() < 0.04  # the error of codes and cells, most of it far away
    assert np.abs(np.diff(share[:101])).max() < 0.015
    assert np.ptp(tau[-5:]) < 1e-3 * tau[-3], "touching it from inside or outside"


def test_a_sky_at_infinity_is_met() -> None:
    grid = contracted_grid(lambda x: np.full(len(x), -2.0), lambda x: np.linalg.norm(x, axis=-1) > 4)
    for module in MODULES:
        rays_o, rays_d = some_rays()
        result = module.march(grid, 0.02 * rays_o, rays_d, 4)
        assert (result.opacity > 0.99).all() and (result.depth > 3).all()
        assert np.isfinite(result.depth).all() and np.isfinite(result.features).all()


@pytest.mark.parametrize("module", MODULES)
@pytest.mark.parametrize("distance", [1e5, 1e7, 1e12])
def test_the_border_of_space_belongs_to_the_last_cells(module: ModuleType, distance: float) -> None:
    """Samples so far away that float32 rounds a contracted coordinate to 2, where no cell begins, belong to
    the last cells."""

    def sky(x: np.ndarray) -> np.ndarray:
        return np.full(len(x), -2.0)

    def far(x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x, axis=-1) > 4

    grid, codes = contracted_grid(sky, far), dense_codes(sky, far)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    rays_o = (distance * np.repeat(axes, 6, axis=0)).astype(np.float32)
    rays_d = np.tile(axes, (6, 1)).astype(np.float32)
    result = module.march(grid, rays_o, rays_d, 3)
    for index, (o, d) in enumerate(zip(rays_o, rays_d, strict=True)):
        opacity, _, taken, _ = naive(grid, codes, o, d)
        assert result.n_density_samples[index] == taken
        assert result.opacity[index] == pytest.approx(opacity, abs=2e-6)
    assert (result.opacity > 0.99).sum() > 20


def test_normals_point_where_density_falls_on_both_sides_of_the_sphere() -> None:
    """Normals of a ball of radius 0.5 or 3 point away from its middle, and a wall is flat, near and far."""
    for radius in (0.5, 3.0):
        grid = contracted_grid(
            lambda x, radius=radius: 30 * (radius - np.linalg.norm(x, axis=-1)) / radius,
            lambda x, radius=radius: np.abs(np.linalg.norm(x, axis=-1) / radius - 1) < 0.4,
        )
        directions = some_rays(200)[1]
        normals = composited_normals(grid, -8 * directions, directions)
        towards = np.sum(normals * -directions, axis=-1)
        assert (
            towards.min() > 0.9 and towards.mean() > 0.98
        )  # codes are rounded, cells are a sixth of the ball
    wall = contracted_grid(lambda x: 6 * (x[:, 0] - 1.5), lambda x: np.abs(x[:, 0] - 1.5) < 0.9)
    directions = np.float32([[1, y, z] for y in (-1, 0, 1) for z in (-1, 0, 1)])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    normals = composited_normals(wall, 0 * directions, directions)
    assert (normals[:, 0] < -0.97).all()


@pytest.mark.parametrize("module", MODULES)
def test_hard_inputs(module: ModuleType) -> None:
    grid = contracted_grid(bumps, shells)
    none = np.zeros((0, 3), np.float32)
    assert module.march(grid, none, none, 4).features.shape == (0, 4)
    opaque = contracted_grid(lambda x: np.full(len(x), 8.0), shells)
    rays_o, rays_d = some_rays(50)
    rays_o = np.concatenate([rays_o, np.zeros((1, 3), np.float32), np.float32([[1e4, 0, 0]])])
    rays_d = np.concatenate([rays_d, np.float32([[0, 0, 1], [-1, 0, 0]])])
    for k in (0, 5):
        result = module.march(opaque, rays_o, rays_d, k)
        assert all(np.isfinite(column).all() for column in result)
        assert result.opacity[-2:].min() > 0.99
    nothing = replace(grid, table=np.full_like(grid.table, -2))
    assert not module.march(nothing, rays_o, rays_d, 5).opacity.any()


def test_the_lattice_covers_every_ray() -> None:
    """The longest ray, one that comes from infinity, ends before the table of the lattice does."""
    grid = contracted_grid(bumps, shells)
    rays = enter_space(grid, np.float32([[-1e6, 0.5, 0]]), np.float32([[1, 0, 0]]))
    assert lattice(float(grid.step))[0, -1] > rays.length[0] > 0.99 * np.pi
