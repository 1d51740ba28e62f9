"""Tests of marches through pyramids of several levels against the naive loop, and of what must not show."""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType

import numpy as np
import pytest

from player.asset.pyramid import Pyramid, whole_pyramid
from player.compiled import march as march_compiled
from player.march import march
from player.march.march import MIN_OPACITY
from tests.player.march.pyramid_scene import PyramidScene, ball, bricks_of, filled, random_scene, sparse_scene

MARCHES = [pytest.param(march, id="numpy"), pytest.param(march_compiled, id="numba")]
STEPS = [(1,), (1, 1), (1, 2), (1, 1, 2), (2, 2, 4), (1, 4, 4, 8)]


def rays(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return rays from all around and from inside, and along the faces of cells and of the box."""
    random = np.random.default_rng(seed)
    rays_o = random.normal(size=(n, 3)) * random.uniform(0.2, 2, (n, 1))
    rays_d = random.uniform(-0.7, 0.7, (n, 3)) - rays_o
    special = [
        ((-3, 0, 0), (1, 0, 0)),
        ((0.25, 0.5, 3), (0.0, -0.0, -1)),
        ((0, 0, 0), (0, 1, 0)),
        ((-3, 1, 0), (1, 0, 0)),
        ((1, -3, -1), (0, 1, 0)),
        ((-2, -2, -2), (1, 1, 1)),
        ((5, 5, 5), (1, 0, 0)),
    ]
    o, d = (np.array(column, np.float64) for column in zip(*special, strict=True))
    rays_o, rays_d = np.concatenate([rays_o, o]), np.concatenate([rays_d, d])
    rays_d /= np.linalg.norm(rays_d, axis=1, keepdims=True)
    return rays_o.astype(np.float32), rays_d.astype(np.float32)


@lru_cache(4)  # both marches are compared with one result
def naive(scene: PyramidScene, k: int, n: int) -> list[tuple[float, float, int, np.ndarray]]:
    return [scene.march(o, d, k) for o, d in zip(*rays(n), strict=True)]


def compare(scene: PyramidScene, module: ModuleType, k: int, n: int = 60) -> int:
    """Compare a march of rays with the naive loop; return how many rays hit."""
    rays_o, rays_d = rays(n)
    result = module.march(scene.grid, rays_o, rays_d, k)
    opacity, depth, taken, features = zip(*naive(scene, k, n), strict=True)
    assert result.n_density_samples.tolist() == list(taken)
    np.testing.assert_allclose(result.opacity, opacity, rtol=0, atol=2e-5)
    assert result.hits.tolist() == [i for i, a in enumerate(opacity) if a > MIN_OPACITY]
    if len(result.hits):
        scale = np.maximum(1, np.abs(depth))[result.hits]
        assert (np.abs(result.depth - depth)[result.hits] <= 2e-4 * scale).all()
        wanted = np.array([features[i] for i in result.hits])
        np.testing.assert_allclose(result.features, wanted, rtol=0, atol=0.05)
    return len(result.hits)


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("contracted", [False, True], ids=["box", "space"])
@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("k", [0, 3])
def test_march_is_the_naive_loop(
    module: ModuleType, contracted: bool, steps: tuple[int, ...], k: int
) -> None:
    scene = random_scene(44, 30, steps, seed=len(steps), contracted=contracted)
    assert compare(scene, module, k) > 20


def linear(pyramid: Pyramid, slope: tuple[int, int, int], at_zero: int) -> list[np.ndarray]:
    return [
        v.index @ np.array(slope)[:, None] * 2**level + at_zero for level, v in enumerate(pyramid.vertices)
    ]


def ramp(pyramid: Pyramid, level_steps: tuple[int, ...], step: float = 0.02) -> PyramidScene:
    codes = filled(pyramid, linear(pyramid, (1, 1, 1), 60), (0, 255), np.uint8)
    features = filled(pyramid, linear(pyramid, (2, -1, 1), -20), (-127, 127), np.int8)
    return PyramidScene(codes, features, step, level_steps)


def full(resolution: int, level: int) -> np.ndarray:
    return np.argwhere(np.ones((-(-resolution // 2**level),) * 3, bool))


@lru_cache
def shapes(resolution: int) -> dict[str, Pyramid]:
    """Return pyramids that fill the box, by name."""
    none, middle = np.zeros((0, 3), int), np.full(3, 0.5)
    whole = {
        "one level": [full(resolution, 0)],
        "all coarse": [none, none, full(resolution, 2)],
        "fine in coarse": [ball(resolution, 0, middle, 0.2), full(resolution, 1)],
        "a level between is hidden": [np.argwhere(np.ones((16,) * 3)), none, full(resolution, 2)],
        "three": [
            ball(resolution, 0, middle, 0.15), ball(resolution, 1, middle - 0.2, 0.3), full(resolution, 2)
        ],
    }  # fmt: skip
    return {name: _without_gaps(resolution, leaves) for name, leaves in whole.items()}


def _without_gaps(resolution: int, leaves: list[np.ndarray]) -> Pyramid:
    """Return the pyramid with full bricks wherever `leaves` have a cell or a finer level has a brick."""
    filled_leaves, names = [], set()
    for level, cells in enumerate(leaves):
        all_cells = full(resolution, level)
        names = {tuple(c >> 1 for c in brick) for brick in names} | set(
            map(tuple, np.unique(cells >> 3, axis=0))
        )
        wanted = np.zeros((resolution,) * 3, bool)
        for brick in names:
            wanted[brick] = True
        there = wanted[tuple((all_cells >> 3).T)]
        filled_leaves.append(bricks_of(all_cells[there]))
    return whole_pyramid(resolution, filled_leaves)


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("name", [name for name in shapes(32) if name != "one level"])
@pytest.mark.parametrize("k", [0, 4])
def test_a_ramp_is_seamless_where_levels_meet(module: ModuleType, name: str, k: int) -> None:
    """Density and features that are linear in the place give the pictures of one level, if all levels take
    base steps."""
    one, many = (
        ramp(shapes(32)[which], (1,) * len(shapes(32)[which].levels)) for which in ("one level", name)
    )
    rays_o, rays_d = rays(400)
    expected, got = (module.march(scene.grid, rays_o, rays_d, k) for scene in (one, many))
    assert (expected.n_density_samples == got.n_density_samples).all()
    np.testing.assert_allclose(got.opacity, expected.opacity, rtol=0, atol=2e-6)
    np.testing.assert_allclose(got.features, expected.features, rtol=0, atol=1e-3)


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("name", shapes(32))
@pytest.mark.parametrize("resolution", [32, 27])
def test_steps_of_the_size_of_the_level(module: ModuleType, name: str, resolution: int) -> None:
    pyramid = shapes(resolution)[name]
    steps = tuple(2**level for level in range(len(pyramid.levels)))
    assert compare(ramp(pyramid, steps), module, 4, n=20) > 15


@pytest.mark.parametrize("module", MARCHES)
def test_coarse_places_take_fewer_samples(module: ModuleType) -> None:
    pyramid = shapes(32)["fine in coarse"]
    few, many = (module.march(ramp(pyramid, steps).grid, *rays(300), 0) for steps in ((1, 4), (1, 1)))
    hits = many.n_density_samples > 20
    assert few.n_density_samples[hits].sum() < 0.6 * many.n_density_samples[hits].sum()
    np.testing.assert_allclose(few.opacity, many.opacity, rtol=0, atol=0.02)


def test_numba_is_numpy_on_many_rays() -> None:
    for contracted in (False, True):
        scene = random_scene(60, 50, (1, 2, 4), seed=9, contracted=contracted)
        rays_o, rays_d = rays(5000, seed=1)
        for k in (0, 4):
            a, b = (module.march(scene.grid, rays_o, rays_d, k) for module in (march, march_compiled))
            same = a.n_density_samples == b.n_density_samples
            assert (~same).sum() <= 5, "cells are the same but where cosines are rounded differently"
            np.testing.assert_allclose(a.opacity[same], b.opacity[same], rtol=0, atol=1e-5)


@pytest.mark.parametrize("contracted", [False, True], ids=["box", "space"])
@pytest.mark.parametrize("steps", [(1,), (4,), (1, 16), (1, 1, 2), (1, 1, 1, 1, 2, 4, 4, 16)])
def test_what_is_far_apart_is_jumped_to(steps: tuple[int, ...], contracted: bool) -> None:
    """Both marches jump over wide gaps, and agree with the loop that jumps nowhere."""
    scene = sparse_scene(steps, len(steps), contracted)
    rays_o, rays_d = rays(2000, seed=2)
    a, b = (module.march(scene.grid, rays_o, rays_d, 3) for module in (march, march_compiled))
    assert (a.n_density_samples == b.n_density_samples).all()
    np.testing.assert_allclose(a.opacity, b.opacity, rtol=0, atol=1e-6)
    np.testing.assert_allclose(a.features, b.features, rtol=0, atol=0.02)
    some = np.flatnonzero(a.n_density_samples)[:8]
    expected = [scene.march(rays_o[i], rays_d[i], 3) for i in some]
    assert len(some) == 8 and a.n_density_samples[some].tolist() == [taken for _, _, taken, _ in expected]
    np.testing.assert_allclose(a.opacity[some], [opacity for opacity, *_ in expected], rtol=0, atol=2e-5)


@pytest.mark.parametrize("module", MARCHES)
def test_bounds_do_not_change_a_bit(module: ModuleType) -> None:
    scene = random_scene(44, 30, (1, 2, 4), seed=5)
    rays_o, rays_d = rays(1500, seed=6)
    free = module.march(scene.grid, rays_o, rays_d, 3)
    radius = np.linalg.norm(rays_o, axis=1)
    near, far = np.maximum(radius - 1.8, 0).astype(np.float32), (radius + 1.8).astype(np.float32)
    assert len(free.hits) > 300 and (near > 0).any()
    for a, b in zip(free, module.march(scene.grid, rays_o, rays_d, 3, (near, far)), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("contracted", [False, True], ids=["box", "space"])
@pytest.mark.parametrize("steps", STEPS)
def test_jumping_over_dead_cells_does_not_change_a_bit(
    module: ModuleType, contracted: bool, steps: tuple[int, ...]
) -> None:
    """Jumps over dead cells change no bit; larger steps, too, begin where they do without jumps."""
    skipped = 0
    for seed in range(2):
        scene = random_scene(60, 30, steps, seed=seed, contracted=contracted)
        whole, skipping = scene.grid, scene.grid_that_skips
        skipped += int(((whole.table >= 0) & (skipping.table < 0)).sum())
        assert ((whole.table >= 0) | (skipping.table < 0)).all()
        results = [module.march(grid, *rays(200, seed), 3) for grid in (whole, skipping)]
        for name, a, b in zip(results[0]._fields, *results, strict=True):
            assert a.tobytes() == b.tobytes(), name
    assert len(steps) == 1 or skipped > 3
