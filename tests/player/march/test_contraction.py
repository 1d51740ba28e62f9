"""Tests of contracted space against float64 closed forms: the map, its Jacobian, the lattice on a ray."""

from __future__ import annotations

import numpy as np
import pytest

from player.asset.grid import SparseGrid
from player.march.contracted import MAX_SPEED, MIN_COS, ContractedPath, enter_space, lattice
from player.march.contraction import contraction_scale, pull_back
from tests.reference import contract
from tests.vertex_grids import grid_of

BOX = np.array([[-2.0] * 3, [2.0] * 3])


def contracted(v: np.ndarray, divisor: np.ndarray) -> np.ndarray:
    """Contract the points v / divisor, [n, 3] and [n]."""
    return v * contraction_scale(np.linalg.norm(v, axis=-1), divisor)[:, None]


def unit(*x: float) -> np.ndarray:
    return np.array(x) / np.linalg.norm(x)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_contraction_is_the_closed_form(kind: type) -> None:
    rounding = 4 * np.finfo(kind).eps
    random = np.random.default_rng(0)
    points = random.normal(size=(2000, 3)) * 10 ** random.uniform(-3, 3, (2000, 1))
    points = points.astype(kind)
    found = contracted(points, np.ones(2000, kind))
    assert found.dtype == kind
    np.testing.assert_allclose(found, [contract(p) for p in points.astype(np.float64)], rtol=0, atol=rounding)
    shares = random.uniform(0.001, 5, 2000).astype(kind)
    divided = contracted(points * shares[:, None], shares)
    np.testing.assert_allclose(divided, found, rtol=0, atol=2 * rounding)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_contraction_of_hard_points(kind: type) -> None:
    tiny, one = np.finfo(kind).smallest_subnormal, np.ones(1, kind)
    assert (contracted(np.zeros((1, 3), kind), one) == 0).all()
    assert (contracted(np.full((1, 3), tiny), one) == tiny).all()
    for radius in (np.nextafter(one, kind(0)), one, np.nextafter(one, kind(2))):  # both sides of the border
        found = contracted(radius[:, None] * np.array([[0, 1, 0]], kind), one)
        assert found[0, 1] == pytest.approx(radius[0], abs=2e-7)
    endless = contracted(np.array([[0, 0, 3], [-1e18, 1e18, 0]], kind), np.zeros(2, kind))
    half = 2 / np.sqrt(2)
    np.testing.assert_allclose(endless, [[0, 0, 2], [-half, half, 0]], atol=1e-6)
    assert contracted(np.zeros((0, 3), kind), np.zeros(0, kind)).shape == (0, 3)


def test_gradients_are_pulled_back_by_the_jacobian() -> None:
    """Gradients are multiplied by the transposed Jacobian, as found by central differences."""
    random = np.random.default_rng(1)
    for radius in (0.2, 0.99, 1.01, 3.0, 40.0):
        x = unit(*random.normal(size=3)) * radius
        jacobian = np.stack([(contract(x + h) - contract(x - h)) / 2e-6 for h in np.eye(3) * 1e-6], axis=-1)
        gradient = random.normal(size=3)
        divisor = random.uniform(0.1, 2)
        found = pull_back(gradient[:, None], x[:, None] * divisor, np.array([divisor]))[:, 0]
        np.testing.assert_allclose(found, jacobian.T @ gradient, rtol=1e-5, atol=1e-8)


def empty_grid(resolution: int, step: float) -> SparseGrid:
    where, both = (np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64)), (resolution, resolution)
    codes, features = np.zeros(0, np.uint8), np.zeros((0, 1), np.int8)
    return grid_of((*where, codes), (*where, features), both, BOX, step, (0.0, 1.0), True)


def rays_of_all_kinds() -> tuple[np.ndarray, np.ndarray]:
    """Return rays through the middle, past it, touching the unit ball, from inside, from afar, leaving."""
    random = np.random.default_rng(2)
    rays_o = random.normal(size=(400, 3)) * 10 ** random.uniform(-2, 1.5, (400, 1))
    rays_d = random.normal(size=(400, 3))
    rays_d /= np.linalg.norm(rays_d, axis=-1, keepdims=True)
    edge = [
        [[-3, 1, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1]],
        [[-30, 0.999, 0], [1, 0, 0]],
        [[5, 0, 0], [1, 0, 0]],
    ]
    o, d = np.swapaxes(np.array(edge, float), 0, 1)
    return np.concatenate([rays_o, o]).astype(np.float32), np.concatenate([rays_d, d]).astype(np.float32)


def places(step: float) -> tuple[np.ndarray, np.ndarray, ContractedPath, np.ndarray, np.ndarray]:
    """Return rays, their paths, and every base step (ray, n) on them."""
    rays_o, rays_d = rays_of_all_kinds()
    rays = enter_space(empty_grid(512, step), rays_o, rays_d)
    ray, n = np.nonzero(lattice(step)[0, ::2] < rays.length[:, None])
    return rays_o, rays_d, rays, ray, n


def test_no_ray_is_faster_than_the_bound_and_some_reach_it() -> None:
    """|d c(x) / d phi|, in float64, stays within MAX_SPEED along every kind of ray, and nearly reaches it."""
    rays_o, rays_d = (a.astype(np.float64) for a in rays_of_all_kinds())
    fastest = 0.0
    for o, d in zip(rays_o, rays_d, strict=True):
        d = d / np.linalg.norm(d)
        t_nearest = -o @ d
        nearest = o + t_nearest * d
        width = max(1.0, float(np.linalg.norm(nearest)))
        phi = np.linspace(np.arctan2(-t_nearest, width), np.pi / 2 - 1e-4, 20_001)
        points = contracted(np.cos(phi)[:, None] * nearest + width * np.sin(phi)[:, None] * d, np.cos(phi))
        fastest = max(fastest, float(np.max(np.linalg.norm(np.diff(points, axis=0), axis=-1) / np.diff(phi))))
    assert 0.99 * MAX_SPEED < fastest < MAX_SPEED * (1 + 1e-6)


def test_places_on_a_ray_are_those_of_its_t() -> None:
    rays_o, rays_d, rays, ray, n = places(0.02)
    s = rays.sample(n)
    t = rays.distances(ray, s).astype(np.float64)
    assert (t > 0).all() and (np.diff(t)[np.diff(ray) == 0] > 0).all()
    near = np.flatnonzero(t < 500)  # an angle of 1e-7 is 0.03 units there
    x = rays_o[ray] + t[:, None] * rays_d[ray]
    expected = (np.array([contract(p) for p in x[near]]) + 2) * 128
    np.testing.assert_allclose(rays.at(ray[near], s[near]).T, expected, rtol=0, atol=0.03)


def test_ways_add_up_to_the_whole_ray_and_samples_are_few() -> None:
    step = 0.01
    _, _, rays, ray, n = places(step)
    s, ways = rays.sample(n), rays.way(ray, n)
    assert np.isfinite(ways).all() and (ways > 0).all()
    assert np.bincount(ray).max() <= np.pi / step + 1
    before_last = np.flatnonzero(np.diff(ray, append=-1) == 0)
    total = np.bincount(ray[before_last], ways[before_last].astype(np.float64))
    last = np.flatnonzero(np.diff(ray, append=-1) != 0)
    phi = np.arctan2(rays.sin, rays.cos).astype(np.float64)
    to_last = phi[ray[last]] + s[last] - step / 2
    expected = rays.t_nearest + rays.width * np.tan(to_last)
    np.testing.assert_allclose(total, expected, rtol=2e-3)
    assert (expected > 1 / (3 * step)).all(), "what the last sample stands for is far away"
    assert ways.max() < rays.width.max() * step / MIN_COS**2
