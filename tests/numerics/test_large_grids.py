"""Compiled code on arrays of more than 2^31 numbers: marches, fetches and training's kernels, compared with
numpy.

The arrays are files with holes: only pages that are touched take memory, and none stays on a disk for long.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest

from player.asset.asset import MAX_ROWS, GridArrays
from player.asset.bricks import bricks_per_axis
from player.asset.grid import SPARE, SparseGrid, VertexRows
from player.asset.manifest import MAX_RESOLUTION, Manifest
from player.asset.pyramid import Bricks, Pyramid, PyramidValues
from player.compiled import march as march_compiled
from player.errors import FormatError
from player.march import march
from player.march.contracted import MAX_SPEED
from player.march.fetches import MIN_TOTAL, stored_features
from tests.numerics.bounds import Row
from tests.player.march.test_contracted_march import some_rays
from tests.player.march.test_march import random_rays
from vfr_bake.baking.distillation import corners
from vfr_bake.kernels import adam, hash_grid, proposals
from vfr_bake.kernels.density import Limits
from vfr_bake.kernels.latent_rows import CHANNELS, PARTS
from vfr_bake.kernels.stored_features import (
    compose,
    descend,
    descend_density,
    interpolate,
    padded,
    table,
)

F32 = np.float32
N_CHANNELS = 10
LAST_IN_32_BITS = 2**31 // 729 - 1
"""The last slot whose densities all have indices below 2^31."""
MOST_SLOTS = bricks_per_axis(MAX_RESOLUTION) ** 3
"""The largest number of slots that a grid of the format may have."""
MOST_ROWS = 2**31 - 1
LARGE = "257^3 bricks of 729 densities and 2^31 - 1 vertices"
FAR_SAMPLES = Row(
    "Large grids", "samples in the last bricks", LARGE, unit="the numpy march's, exactly",
    at_ends="addresses past 2^31 have 64 bits; dense tables have 32",
)  # fmt: skip
FAR_OPACITY = Row("Large grids", "opacity in the last bricks", LARGE, 5e-6)
FAR_DEPTH = Row("Large grids", "depth in the last bricks", LARGE, 1e-5, "units")
FAR_FEATURES = Row("Large grids", "features in the last bricks", LARGE, 5e-4, "codes")
FAR_ROWS = Row(
    "Large grids",
    "kernels of the bake and the training on rows past 2^31",
    LARGE,
    unit="as on the same rows alone, exactly",
)
TOO_MANY = Row(
    "Large grids", "asset of more than 2^31 - 1 vertices", unit="refused", at_ends="when it is opened"
)


class Zeros(Protocol):
    """Function like `np.zeros`, whose arrays take memory only where they are touched."""

    def __call__(self, shape: int | tuple[int, ...], dtype: type) -> np.ndarray: ...


@pytest.fixture
def zeros(tmp_path: Path) -> Zeros:
    n = 0

    def make(shape: int | tuple[int, ...], dtype: type) -> np.ndarray:
        nonlocal n
        n += 1
        mapped = np.memmap(tmp_path / str(n), dtype, "w+", shape=shape)
        (tmp_path / str(n)).unlink()  # the pages are freed with the array
        return np.asarray(mapped)

    return make


def grid_behind(zeros: Zeros, n_slots: int, n_rows: int, contracted: bool) -> SparseGrid:
    """Return a grid of eight bricks, all cells live: the last of `n_slots`, and the last of `n_rows`."""
    rng = np.random.default_rng(0)
    resolution = 15
    slots = np.arange(n_slots - 8, n_slots, dtype=np.int32)
    live, density = zeros(n_slots * 64, np.uint8), zeros(n_slots * 729 + SPARE, np.uint8)
    live[-8 * 64 :] = 255
    density[-8 * 729 - SPARE :] = rng.integers(0, 256, 8 * 729 + SPARE)
    rows = zeros(n_slots * 729, np.int32)
    rows[-8 * 729 :] = rng.integers(n_rows - 5000, n_rows, 8 * 729)
    rows[-4 * 729 :: 7] = -1
    features = zeros((n_rows, N_CHANNELS), np.int8)
    features[-5000:] = rng.integers(-127, 128, (5000, N_CHANNELS))
    box = 2.0 if contracted else 1.0
    return SparseGrid(
        resolution=resolution,
        n_per_axis=2,
        aabb_min=np.full(3, -box, F32),
        cells_per_unit=np.full(3, resolution / (2 * box), F32),
        step=F32(4 / 96 / float(MAX_SPEED)) if contracted else F32(1 / 40),
        level_steps=np.ones(1, np.int32),
        density_low=F32(-2),
        density_slope=F32(4 / 255),
        slot_coords=np.argwhere(np.ones((2, 2, 2))).astype(np.int32),
        slot_levels=np.zeros(8, np.int32),
        table=slots << 3,
        live=live,
        density=density,
        rows=VertexRows(resolution, 2, slots << 3, rows),
        features=features,
        contracted=contracted,
    )


SIZES = pytest.mark.parametrize(
    ("n_slots", "n_rows"),
    [
        (LAST_IN_32_BITS + 1, 2**31 // N_CHANNELS),
        (LAST_IN_32_BITS + 9, 2**31 // N_CHANNELS + 5000),
        (LAST_IN_32_BITS * 3, 2**30),  # 32 bits wrap around to stored slots, and to others
        (MOST_SLOTS, MOST_ROWS),
    ],
)


@SIZES
@pytest.mark.parametrize("k", [0, 3])
@pytest.mark.parametrize("contracted", [False, True], ids=["box", "space"])
def test_the_compiled_march_reaches_the_last_slot(
    contracted: bool, k: int, n_slots: int, n_rows: int, zeros: Zeros
) -> None:
    grid = grid_behind(zeros, n_slots, n_rows, contracted)
    rays = some_rays(40) if grid.contracted else random_rays(40)
    got, expected = march_compiled.march(grid, *rays, k), march.march(grid, *rays, k)
    assert len(expected.hits) > 20 and np.abs(expected.features).max() > 20
    np.testing.assert_array_equal(got.n_density_samples, expected.n_density_samples)
    np.testing.assert_array_equal(got.hits, expected.hits)
    FAR_SAMPLES.holds()
    FAR_OPACITY.check(got.opacity, expected.opacity)
    FAR_DEPTH.check(got.depth, expected.depth)
    FAR_FEATURES.check(got.features, expected.features)


@pytest.mark.parametrize("n_fetches", [2**31, 10**30])
@pytest.mark.parametrize("contracted", [False, True], ids=["box", "space"])
def test_no_number_of_fetches_is_too_large(contracted: bool, n_fetches: int, zeros: Zeros) -> None:
    """A number of fetches beyond the samples that a ray can have allocates and addresses nothing more."""
    grid = grid_behind(zeros, 8, 5000, contracted)
    rays = some_rays(40) if grid.contracted else random_rays(40)
    np.testing.assert_array_equal(
        march_compiled.march(grid, *rays, n_fetches).features, march_compiled.march(grid, *rays, 0).features
    )


@SIZES
def test_fetches_of_the_bake_reach_the_last_brick(n_slots: int, n_rows: int, zeros: Zeros) -> None:
    grid = grid_behind(zeros, n_slots, n_rows, contracted=False)
    points = np.random.default_rng(1).uniform(-1, 16, (200, 3)).astype(F32)
    rows, shares = corners(grid.rows, points, F32(0))
    assert rows[shares > 0].min() >= n_rows - 5000
    values = (shares[:, :, None] * grid.features[rows].astype(F32)).sum(axis=1)
    expected, total = stored_features(grid, points.T)
    assert (total > MIN_TOTAL).all()
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-4)


def test_stored_features_beyond_32_bits(zeros: Zeros) -> None:
    """Composites of the last rows, and steps on them, are those on the same rows alone."""
    n_rows = 2**31 // N_CHANNELS + 1000
    rng = np.random.default_rng(2)
    near = rng.integers(0, 1000, (50, 8)).astype(np.int32)
    far = near + np.int32(n_rows - 1000)
    shares = rng.uniform(0, 1, (50, 8)).astype(F32)
    starts, weights = np.arange(0, 51, 10), rng.uniform(0, 1, 50).astype(F32)
    gradient = np.zeros((5, padded(N_CHANNELS)), F32)
    gradient[:, :N_CHANNELS] = rng.normal(size=(5, N_CHANNELS))
    small = table(1000, N_CHANNELS)
    small[:] = rng.integers(0, 100 * PARTS, small.shape)
    codes = rng.uniform(0, 100, 1000).astype(F32)
    large = zeros(n_rows * N_CHANNELS + CHANNELS, np.int16)[:-CHANNELS].reshape(n_rows, N_CHANNELS)
    large_codes = zeros(MOST_ROWS, F32)
    large[-1000:], large_codes[-1000:] = small, codes
    out = []
    for latent, rows in ((small, near), (large, far)):
        composites, steepness = np.empty((5, N_CHANNELS), F32), zeros(len(latent), F32)
        compose(starts, rows, shares, weights, latent, composites)
        interpolated = np.empty((50, padded(N_CHANNELS)), F32)
        interpolate(rows, shares, weights, latent, interpolated)
        descend(starts, rows, shares, weights, gradient, F32(0.5), 2, latent, steepness, 3)
        out.append((composites, interpolated[:, :N_CHANNELS], latent[-1000:], steepness[-1000:]))
    for latent, offset in ((codes, 0), (large_codes, MOST_ROWS - 1000)):
        steepness = zeros(len(latent), F32)
        descend_density(near + np.int32(offset), shares, weights, F32(0.5), 2, latent, steepness)
        out.append((latent[-1000:], steepness[-1000:]))
    for ours, expected in ((out[1], out[0]), (out[3], out[2])):
        for a, b in zip(ours, expected, strict=True):
            np.testing.assert_array_equal(a, b)
            assert b.any()
    FAR_ROWS.holds()


SCALES = np.array([7, 12, 30], F32)
HASHED = np.array([False, False, True])
MASK = 2**12 - 1
NEAR = np.array([0, 1000, 4000])
FAR = NEAR + np.array([2**30 - 500, 2**31 - 500, 2**32 + 77])  # first rows of levels


@pytest.mark.parametrize("n_channels", [1, 2])
def test_hash_grid_beyond_32_bits(n_channels: int, zeros: Zeros) -> None:
    """Lookups, scatters and steps far behind in a table are those in a table of the same rows alone."""
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 1, (60, 3)).astype(F32)
    sizes = [9**3, 14**3, MASK + 1]
    values = [rng.normal(size=(size, n_channels)).astype(F32) for size in sizes]
    gradient = rng.normal(size=(60, 2 * len(SCALES))).astype(F32)
    found: list[list[Any]] = []
    for offsets in (NEAR, FAR):
        n_rows = int(offsets[-1]) + sizes[-1]
        table, grad = zeros((n_rows, n_channels), F32), zeros((n_rows, n_channels), F32)
        parts = [slice(int(first), int(first) + size) for first, size in zip(offsets, sizes, strict=True)]
        for part, value in zip(parts, values, strict=True):
            table[part] = value
        levels = hash_grid.TableLevels(SCALES, offsets, HASHED, MASK)
        grid = hash_grid.HashGridArrays(table, *levels)
        if n_channels == 1:
            proposals.scatter_logits(points[:, :, None], gradient[:, :1].copy(), levels, 2, grad)
            edges = np.linspace(0.1, 0.9, 17, dtype=F32)[None].repeat(60, 0)
            arrays = [np.zeros((60, *more, 16), F32) for more in [(), (3,), ()] * 2]
            rounds = [proposals.Round(edges.copy(), *arrays[3 * i : 3 * i + 3]) for i in range(2)]
            proposals.propose(
                points, points, np.full((60, 3), 0.5, F32), (F32(0.1), F32(0.9)), F32(1), grid, grid,
                Limits(F32(10), F32(10)), *rounds, edges,
            )  # fmt: skip
            found.append([edges, *rounds[0][1:], *rounds[1][1:], *(grad[part] for part in parts)])
            continue
        out = np.empty((60, 2 * len(SCALES)), F32)
        hash_grid.encode(points, grid, out)
        hash_grid.scatter(points, gradient, levels, 2, grad)
        moments = zeros((n_rows, 4), F32)
        of_level, rows = np.zeros((2, max(sizes), 2), F32), np.empty((2, 8 * len(points) + 1), np.uint32)
        pace = adam.AdamRates(*map(F32, (0.1, 0.9, 0.99, 1e-8)))
        adam.scatter_and_step(points, gradient, grid, of_level, rows, moments, pace)
        found.append([out, *(array[part] for array in (grad, table, moments) for part in parts)])
    for ours, expected in zip(found[1], found[0], strict=True):
        np.testing.assert_array_equal(ours, expected)
        assert expected.any()
    FAR_ROWS.holds()


def test_what_is_counted_in_32_bits_fits() -> None:
    """Numbers of bricks and of words of live cells fit into 32 bits; all else that grows has 64."""
    assert MOST_SLOTS * 16 < 2**31


def test_more_vertices_than_rows_have_numbers_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert MAX_ROWS == 2**31 - 1, "rows are int32"
    monkeypatch.setattr("player.asset.asset.MAX_ROWS", 7)
    manifest = Manifest(
        generator="test",
        resolution=8,
        feature_resolution=8,
        step=0.1,
        density_range=(-5, 5),
        n_channels=1,
        view_size=(4, 3),
    )
    cell = Bricks(np.zeros((1, 3), np.uint16), np.array([[1, 0, 0, 0, 0, 0, 0, 0]], np.uint64))
    pyramid = Pyramid(8, (cell,))
    arrays = GridArrays(*(PyramidValues(pyramid, (np.zeros((8, 1), kind),)) for kind in (np.uint8, np.int8)))
    with pytest.raises(FormatError, match="at most 7 vertices, got 8"):
        arrays.check(manifest)
    TOO_MANY.holds()
