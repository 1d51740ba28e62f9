"""Tests of the two marches against the naive loop, and of what must not change a picture."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from player.asset.asset import Asset
from player.asset.bricks import pack_vertices
from player.asset.grid import SparseGrid
from player.compiled import march as march_compiled
from player.march import march
from player.march.fetches import Samples, equal_mass_bins, heaviest
from player.march.march import MIN_OPACITY
from tests.numerics.bounds import Row
from tests.player.conftest import DENSITY_RANGE, RESOLUTION, STEP, shells
from tests.player.march.oracle_march import Scene, bins, march_ray
from tests.vertex_grids import grid_of, rows_of

# float32 rounds by 2^-24, over some dozen samples of optical depth up to 7; measured 1e-6.
OPACITY = 5e-6
# s and the depth are rounded to 2^-22 in a box of 2 units.
DEPTH = 5e-6
# Codes are up to 127, change by 3 per cell, and places are known to 1e-5 cells; measured 1e-4.
FEATURES = 5e-4

BOTH = "The two marches"
LOOP_OPACITY = Row(
    BOTH, "opacity, against a float64 loop", "k = 0, 1, 2, 5; rays in and along faces", OPACITY
)
LOOP_DEPTH = Row(
    BOTH,
    "depth, against a float64 loop",
    "the same",
    DEPTH,
    "of the origin's distance, which counts as 1 at least",
)
LOOP_FEATURES = Row(BOTH, "features, against a float64 loop", "the same", FEATURES, "codes")
TWIN_OPACITY = Row(
    BOTH, "opacity of one march, against the other", "20,000 rays, k = 0 and 5", OPACITY,
    at_ends="2 rays may end a sample later: an optical depth within rounding of the threshold",
)  # fmt: skip
TWIN_FEATURES = Row(BOTH, "features of one march, against the other", "the same", FEATURES, "codes")

MARCHES = [pytest.param(march, id="numpy"), pytest.param(march_compiled, id="numba")]


def random_rays(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    rays_o = rng.normal(size=(n, 3)) * 2
    rays_d = rng.uniform(-1, 1, (n, 3)) - rays_o
    return rays_o.astype(np.float32), (rays_d / np.linalg.norm(rays_d, axis=1, keepdims=True)).astype(
        np.float32
    )


def special_rays() -> tuple[np.ndarray, np.ndarray]:
    half = 0.5**0.5
    rows = [
        ((-3, 0.1, 0.2), (1, 0, 0)),
        ((3, 0.1, 0.2), (-1, -0.0, -0.0)),
        ((0.1, 3, -0.2), (-0.0, -1, 0.0)),
        ((0.1, 0.3, -3), (0.0, -0.0, 1)),
        ((0, 0, 0), (1, 0, 0)),  # starts inside, on vertices
        ((0.02, -0.01, 0.03), (half, half, 0)),
        ((0.5, 0, 0), (0, 0, 1)),  # starts in a shell
        ((5, 5, 5), (1, 0, 0)),  # misses, pointing away
        ((-3, 2, 0), (1, 0, 0)),  # misses, parallel to a slab outside it
        ((-3, 1, 0), (1, 0, 0)),  # in the upper face
        ((-3, -1, 0), (1, -0.0, 0)),  # in the lower face
        ((1, -3, 0), (0, 1, 0)),
        ((-3, 0.99, 0.01), (1, 0, 0)),  # grazes the outer shell
        ((-3, 0.515, 0.01), (1, 0, 0)),  # grazes the inner shell
        ((-2, -2, 0), (half, half, 0)),
        ((-1, 0, 0), (1, 0, 0)),  # starts on a face
        ((1, 0, 0), (1, 0, 0)),  # leaves from a face
        ((200, 0.3, 0.1), (-1, 0, 0)),
    ]
    rays_o, rays_d = (np.array(column, np.float32) for column in zip(*rows, strict=True))
    return rays_o, rays_d


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("k", [0, 3])
def test_rays_that_end_earlier_lose_no_light(module: ModuleType, k: int, asset: Asset) -> None:
    """Rays that end at a limit of optical depth count as opaque, and composite a feature that is the same
    everywhere unchanged. Rays that do not reach the limit give the same bytes as without it."""
    rays, limit = random_rays(300, seed=4), np.float32(np.log(10))
    whole, ended = module.march(asset.grid, *rays, k), module.march(asset.grid, *rays, k, None, limit)
    shorter = ended.opacity == 1
    assert 0.1 < shorter.mean() < 0.9
    assert (whole.opacity[shorter] > 0.9).all() and (whole.opacity[~shorter] <= 0.9 + OPACITY).all()
    assert (ended.n_density_samples <= whole.n_density_samples).all()
    assert ended.n_density_samples.sum() < 0.95 * whole.n_density_samples.sum()
    for name in ("opacity", "depth", "n_density_samples"):
        assert getattr(ended, name)[~shorter].tobytes() == getattr(whole, name)[~shorter].tobytes(), name
    of_all, of_ended = (np.zeros((300, 4), np.float32) for _ in range(2))
    of_all[whole.hits], of_ended[ended.hits] = whole.features, ended.features
    assert of_ended[~shorter].tobytes() == of_all[~shorter].tobytes()
    same = replace(asset.grid, features=np.full_like(asset.grid.features, 50))
    found = module.march(same, *rays, k, None, limit)
    of_rays = found.opacity[found.hits, None] * np.full(4, 50)
    np.testing.assert_allclose(found.features, of_rays, rtol=1e-5)


@pytest.mark.parametrize("limit", [0.0, 1e-3, 1.0, 2.3])
@pytest.mark.parametrize("k", [0, 1, 3])
def test_both_marches_end_rays_alike(k: int, limit: float, asset: Asset) -> None:
    rays = random_rays(200, seed=5)
    a, b = (m.march(asset.grid, *rays, k, None, np.float32(limit)) for m in (march, march_compiled))
    assert a.hits.tolist() == b.hits.tolist()
    assert a.n_density_samples.tolist() == b.n_density_samples.tolist()
    np.testing.assert_allclose(a.opacity, b.opacity, rtol=0, atol=OPACITY)
    np.testing.assert_allclose(a.depth, b.depth, rtol=0, atol=1e-4)
    np.testing.assert_allclose(a.features, b.features, rtol=0, atol=FEATURES)


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("k", [0, 1, 2, 5])
@pytest.mark.parametrize("rays", [random_rays(150), special_rays()], ids=["random", "special"])
def test_march_is_the_naive_loop(
    module: ModuleType, k: int, rays: tuple[np.ndarray, np.ndarray], asset: Asset, scene: Scene
) -> None:
    result = module.march(asset.grid, *rays, k)
    expected = [march_ray(scene, o, d, k) for o, d in zip(*rays, strict=True)]
    assert result.opacity.dtype == result.depth.dtype == result.features.dtype == np.float32
    assert result.n_density_samples.tolist() == [ray.taken for ray in expected]
    LOOP_OPACITY.check(result.opacity, [ray.opacity for ray in expected])
    scale = np.maximum(1, np.linalg.norm(rays[0], axis=1))
    LOOP_DEPTH.check(result.depth, [ray.depth for ray in expected], of=scale)
    assert result.hits.tolist() == [i for i, ray in enumerate(expected) if ray.opacity > MIN_OPACITY]
    LOOP_FEATURES.check(result.features, np.array([expected[i].features for i in result.hits]))


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("k", [0, 5])
def test_march_through_a_box_of_three_different_edges(module: ModuleType, k: int, scene: Scene) -> None:
    """The march is right where cells are longer along one axis than along another: every axis has a scale
    and a corner of its own."""
    vertices, codes, features = shells()
    box = np.array([[-1.5, -0.7, -1.0], [1.1, 0.6, 2.5]])
    where = pack_vertices(vertices)[:2]
    grid = grid_of((*where, codes), (*where, features), (RESOLUTION, RESOLUTION), box, STEP, DENSITY_RANGE)
    unit_o, unit_d = random_rays(80, seed=10)
    edges = np.diff(box, axis=0)[0]
    rays_o = ((unit_o + 1) / 2 * edges + box[0]).astype(np.float32)
    rays_d = unit_d * edges
    rays_d = (rays_d / np.linalg.norm(rays_d, axis=1, keepdims=True)).astype(np.float32)
    result = module.march(grid, rays_o, rays_d, k)
    other = replace(scene, aabb=box)
    expected = [march_ray(other, o, d, k) for o, d in zip(rays_o, rays_d, strict=True)]
    assert result.n_density_samples.tolist() == [ray.taken for ray in expected] and len(result.hits) > 30
    np.testing.assert_allclose(result.opacity, [ray.opacity for ray in expected], rtol=0, atol=OPACITY)
    np.testing.assert_allclose(result.depth, [ray.depth for ray in expected], rtol=0, atol=4 * DEPTH)
    features = np.array([expected[i].features for i in result.hits])
    np.testing.assert_allclose(result.features, features, rtol=0, atol=2 * FEATURES)


def test_the_special_rays_meet_and_miss(scene: Scene) -> None:
    taken = [march_ray(scene, o, d, 5).taken for o, d in zip(*special_rays(), strict=True)]
    assert min(taken) == 0 and sum(n > 0 for n in taken) >= 10


def test_bins_of_the_scene_fall_into_the_gap(scene: Scene) -> None:
    """With k = 1 the centroid of samples in two shells is between them: the heaviest sample is taken."""
    rays = [march_ray(scene, o, d, 1) for o, d in zip(*random_rays(150), strict=True)]
    moved = [ray for ray in rays if ray.fetches and len(ray.samples) > 1]
    assert sum(abs(r.fetches[0][0] - bins(r.samples, 1)[0][0]) > 1e-3 for r in moved) > 20


def test_numba_is_numpy_on_many_rays(asset: Asset) -> None:
    rays = random_rays(20_000, seed=1)
    for k in (0, 5):
        a, b = march.march(asset.grid, *rays, k), march_compiled.march(asset.grid, *rays, k)
        same = a.n_density_samples == b.n_density_samples
        assert (~same).sum() <= 2, "only a tau within rounding of the threshold may stop a sample later"
        TWIN_OPACITY.check(a.opacity[same], b.opacity[same])
        assert (a.hits == b.hits).all()
        same = same[a.hits]
        TWIN_FEATURES.check(a.features[same], b.features[same])


@pytest.mark.parametrize("module", MARCHES)
def test_opacity_does_not_depend_on_k(module: ModuleType, asset: Asset) -> None:
    rays = random_rays(3000, seed=2)
    results = [module.march(asset.grid, *rays, k) for k in (0, 1, 3, 5, 64)]
    for result in results[1:]:
        assert (result.opacity == results[0].opacity).all() and (result.depth == results[0].depth).all()


@pytest.mark.parametrize("module", MARCHES)
def test_k_over_the_number_of_samples_is_all_samples(module: ModuleType, asset: Asset) -> None:
    rays = random_rays(3000, seed=3)
    every, many = (module.march(asset.grid, *rays, k) for k in (0, 1000))
    assert every.n_density_samples.max() < 1000
    assert (every.features == many.features).all()


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("k", [0, 1, 5])
def test_constant_feature_is_multiplied_by_opacity(module: ModuleType, k: int, asset: Asset) -> None:
    result = module.march(asset.grid, *random_rays(3000, seed=4), k)
    np.testing.assert_allclose(result.features[:, 3], 50 * result.opacity[result.hits], rtol=1e-5, atol=0)


@pytest.mark.parametrize("module", MARCHES)
def test_linear_features_give_the_mean_position(module: ModuleType, asset: Asset) -> None:
    """Features that are linear in the place, divided by the opacity, give the mean position of the samples;
    errors at brick borders and offsets would show."""
    rays_o, rays_d = random_rays(4000, seed=5)
    result = module.march(asset.grid, rays_o, rays_d, 0)
    hits = result.hits
    point = rays_o[hits] + result.depth[hits, None] * rays_d[hits]
    expected = (point + 1) * 32 * 3 - 96
    got = result.features[:, :3] / result.opacity[hits, None]
    np.testing.assert_allclose(got, expected, rtol=0, atol=0.02)
    assert np.abs(got - (expected + 1.5)).max() > 1, "half a voxel is 1.5 codes"


@pytest.mark.parametrize("module", MARCHES)
def test_bounds_do_not_change_a_bit(module: ModuleType, asset: Asset) -> None:
    rays_o, rays_d = random_rays(3000, seed=6)
    free = module.march(asset.grid, rays_o, rays_d, 5)
    radius = np.linalg.norm(rays_o, axis=1)
    near, far = np.maximum(radius - 1.2, 0).astype(np.float32), (radius + 1.2).astype(np.float32)
    for a, b in zip(free, module.march(asset.grid, rays_o, rays_d, 5, (near, far)), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("kind", [np.int8, np.float32])
@pytest.mark.parametrize("n_channels", [1, 15, 16, 17, 40])
def test_numba_is_numpy_in_any_number_of_channels(n_channels: int, kind: type, asset: Asset) -> None:
    """Both marches agree in any number of channels, which are added sixteen at a time, but one by one for the
    last rows in memory."""
    features = np.random.default_rng(8).integers(-128, 128, (len(asset.grid.features), n_channels), np.int8)
    features = features.astype(kind)  # the bake measures features before they are codes
    grid = replace(asset.grid, features=features)
    rays = random_rays(2000, seed=8)
    for k in (0, 5):
        a, b = march.march(grid, *rays, k), march_compiled.march(grid, *rays, k)
        assert a.features.shape == b.features.shape == (len(a.hits), n_channels)
        np.testing.assert_allclose(a.features, b.features, rtol=0, atol=40 * FEATURES)  # noise, not 3 a cell


def with_linear_features(grid: SparseGrid, resolution: int) -> SparseGrid:
    """Return the grid with features on every vertex of a grid of `resolution`: linear in the place, and one
    that is 50."""
    index = np.argwhere(np.ones((resolution + 1,) * 3))
    coords, masks, order = pack_vertices(index)
    place = index[order] * np.float32(120 / resolution) - 60
    features = np.concatenate([place, np.full((len(place), 1), 50)], axis=1).astype(np.float32)
    return replace(grid, rows=rows_of(coords, masks, resolution), features=features)


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("resolution", [8, 20, 33, 90])
@pytest.mark.parametrize("k", [0, 3])
def test_features_on_a_grid_of_their_own(module: ModuleType, resolution: int, k: int, asset: Asset) -> None:
    """Linear features are the same on a grid coarser, of no simple ratio, or finer than the densities'."""
    rays = random_rays(1000, seed=9)
    own = module.march(with_linear_features(asset.grid, RESOLUTION), *rays, k)
    other = module.march(with_linear_features(asset.grid, resolution), *rays, k)
    assert len(own.hits) > 300 and own.opacity.tobytes() == other.opacity.tobytes()
    np.testing.assert_allclose(other.features, own.features, rtol=0, atol=2e-3)


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("k", [0, 5])
def test_no_rays(module: ModuleType, k: int, asset: Asset) -> None:
    none = np.zeros((0, 3), np.float32)
    result = module.march(asset.grid, none, none, k)
    assert [a.shape for a in result] == [(0,), (0,), (0,), (0,), (0, 4)]


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("k", [0, 5])
def test_only_misses(module: ModuleType, k: int, asset: Asset) -> None:
    rays_o = np.full((3, 3), 9, np.float32)
    result = module.march(asset.grid, rays_o, np.float32([[1, 0, 0]] * 3), k)
    assert not result.opacity.any() and not result.depth.any() and len(result.features) == 0


def test_bins_have_equal_mass_and_the_naive_centroids() -> None:
    rng = np.random.default_rng(7)
    lengths = rng.integers(6, 40, 50)
    ray = np.repeat(np.arange(50) * 3, lengths)
    s = np.concatenate([np.sort(rng.uniform(0, 3, n)) for n in lengths]).astype(np.float32)
    weights = rng.exponential(1, len(s)).astype(np.float32) ** 3
    got = equal_mass_bins(Samples(ray, s, weights), 5)
    assert got.ray.tolist() == np.repeat(np.arange(50) * 3, 5).tolist()
    found = s[heaviest(got, np.arange(250))]
    for i in range(50):
        mine = ray == i * 3
        pairs = list(zip(s[mine].astype(float), weights[mine].astype(float), strict=True))
        expected = bins(pairs, 5)
        np.testing.assert_allclose(got.s[i * 5 : i * 5 + 5], [c for c, _ in expected], rtol=0, atol=1e-6)
        np.testing.assert_allclose(found[i * 5 : i * 5 + 5], [h for _, h in expected], rtol=0, atol=1e-6)
        mean = np.dot(s[mine], weights[mine].astype(float)) / weights[mine].sum()
        assert abs(got.s[i * 5 : i * 5 + 5].mean() - mean) < 1e-6, "equal masses keep the mean"
