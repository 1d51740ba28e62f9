"""Tests of bricks, density codes and the grid that is built from them, against plain dense arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from player.asset.asset import Asset
from player.asset.bricks import bricks_per_axis, pack_vertices, unpack_vertices
from player.asset.density import decode_density, encode_density
from player.asset.grid import MAX_DISTANCE, build_grid
from player.asset.pyramid import Bricks, Pyramid, live_cells
from player.asset.single_level import VertexBricks, from_vertices
from player.march.fetches import stored_features
from tests.numerics.bounds import Row
from tests.player.in_parts import write_in_parts

DENSITY = Row(
    "Density and optical depth", "density (player)", "exp(-80) to exp(80), 8 bits of the logarithm", 3e-5,
    "of it, in float32", "clipped to the manifest's range; no NaN can be stored",
)  # fmt: skip
RANGES = [(-2.0, 6.0), (-6.0, 7.0), (-80.0, 80.0), (0.0, 1e-3)]


@pytest.mark.parametrize("density_range", RANGES, ids=str)
def test_every_code_survives_decoding_and_encoding(density_range: tuple[float, float]) -> None:
    codes = np.arange(256)
    low, high = density_range
    exact = low + (high - low) * codes / 255
    assert encode_density(exact, density_range).tolist() == codes.tolist()
    sigmas = decode_density(codes, density_range)
    assert sigmas.dtype == np.float32 and np.isfinite(sigmas).all()
    # float32 errors: half an ulp of the exponent (up to 80 * 2^-24), and a few ulps of the sum
    DENSITY.check(sigmas, np.exp(exact), of=np.exp(exact))


def test_codes_are_clipped_and_rounded_to_the_nearest() -> None:
    log_sigmas = np.array([-np.inf, -1e30, 0.49, 0.51, 254.51, 1e30, np.inf])
    DENSITY.holds(encode_density(log_sigmas, (0.0, 255.0)) == [0, 0, 0, 1, 255, 255, 255])
    assert encode_density(np.zeros((0, 2)), (0.0, 1.0)).shape == (0, 2)


def random_vertices(resolution: int, share: float, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((resolution + 1,) * 3) < share


@pytest.mark.parametrize("resolution", [1, 7, 8, 20])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.8, 1.0])
def test_packing_round_trip_and_live_cells(resolution: int, share: float) -> None:
    dense = random_vertices(resolution, share, seed=resolution)
    vertices = np.random.default_rng(1).permutation(np.argwhere(dense))
    coords, masks, order = pack_vertices(vertices)
    assert (unpack_vertices(coords, masks) == vertices[order]).all()
    keys = [tuple(c) for c in coords.tolist()]
    assert keys == sorted(set(keys))
    n = bricks_per_axis(resolution)
    live = live_cells(Bricks(coords, masks))
    found = np.zeros((n * 8,) * 3, bool)
    found[tuple(unpack_vertices(live.coords, live.masks).T)] = True
    expected = np.ones((resolution,) * 3, bool)
    for i, j, k in np.ndindex(2, 2, 2):
        expected &= dense[i : i + resolution, j : j + resolution, k : k + resolution]
    assert (found[:resolution, :resolution, :resolution] == expected).all() and found.sum() == expected.sum()


@pytest.mark.parametrize("resolution", [1, 7, 8, 20])
@pytest.mark.parametrize("share", [0.0, 0.8, 0.97, 1.0])
def test_vertices_become_a_pyramid_of_one_level(resolution: int, share: float) -> None:
    """A pyramid made from vertices has those that its bricks alone would give, each with its own code."""
    vertices = np.argwhere(random_vertices(resolution, share, seed=resolution))
    coords, masks, order = pack_vertices(vertices)
    codes = np.arange(len(vertices)).astype(np.uint16)
    found = from_vertices(VertexBricks(coords, masks, codes), resolution)
    (own,), (again,) = found.pyramid.vertices, Pyramid(resolution, found.pyramid.levels).vertices
    assert own.n == again.n == len(found.values[0]) and not own.on_border.any()
    assert (own.bricks.coords == again.bricks.coords).all() and (own.bricks.masks == again.bricks.masks).all()
    assert (vertices[order][found.values[0][:, 0]] == own.index).all()
    assert own.n == len(vertices) if share in (0, 1) else resolution < 20 or 0 < own.n < len(vertices)


def test_one_missing_corner_kills_eight_cells() -> None:
    dense = np.ones((21, 21, 21), bool)
    dense[8, 8, 8] = False
    coords, masks, _ = pack_vertices(np.argwhere(dense))
    live = live_cells(Bricks(coords, masks))
    dead = set(map(tuple, np.argwhere(np.ones((20,) * 3)).tolist()))
    dead -= set(map(tuple, unpack_vertices(live.coords, live.masks).tolist()))
    assert dead == {(7 + i, 7 + j, 7 + k) for i, j, k in np.ndindex(2, 2, 2)}


@pytest.mark.parametrize("share", [0.3, 0.97])
def test_grid_against_dense_arrays(share: float) -> None:
    resolution, rng = 37, np.random.default_rng(3)
    dense = random_vertices(resolution, share, seed=4)
    dense[8:24, :, :] = False
    vertices = np.argwhere(dense)
    coords, masks, order = pack_vertices(vertices)
    vertices = vertices[order]
    codes = rng.integers(1, 256, len(vertices)).astype(np.uint8)
    features = rng.integers(-128, 128, (len(vertices), 3)).astype(np.int8)
    densities, stored = (from_vertices(VertexBricks(coords, masks, n), resolution) for n in (codes, features))
    grid = build_grid(densities, stored, np.array([[-1] * 3, [1] * 3]), 0.1, (1,), (0, 1))
    cells = np.ones((resolution,) * 3, bool)
    for x, y, z in np.ndindex(2, 2, 2):
        cells &= dense[x : x + resolution, y : y + resolution, z : z + resolution]
    corners = np.zeros((resolution + 1,) * 3, bool)
    for x, y, z in np.ndindex(2, 2, 2):
        corners[x : x + resolution, y : y + resolution, z : z + resolution] |= cells
    kept = corners[tuple(vertices.T)]
    assert 0 < kept.sum() < len(kept), "some vertices are corners of no live cell"
    vertices, codes = vertices[kept], codes[kept]
    assert (grid.features == features[kept]).all()
    n = grid.n_per_axis
    full = np.zeros((n * 8 + 1,) * 3, np.uint8)
    full[tuple(vertices.T)] = codes
    apron = grid.codes.reshape(-1, 9, 9, 9)
    for slot, (x, y, z) in enumerate(grid.slot_coords.tolist()):
        assert grid.table[(x * n + y) * n + z] == slot << 3
        assert (apron[slot] == full[x * 8 : x * 8 + 9, y * 8 : y * 8 + 9, z * 8 : z * 8 + 9]).all()
    rows = np.full((n * 8,) * 3, -1)
    rows[tuple(vertices.T)] = np.arange(len(vertices))
    for x, y, z in np.unique(vertices >> 3, axis=0).tolist():
        brick = grid.rows.bricks[(x * n + y) * n + z]
        got = grid.rows.rows.reshape(-1, 9, 9, 9)[brick >> 3][:8, :8, :8]
        assert (got == rows[x * 8 : x * 8 + 8, y * 8 : y * 8 + 8, z * 8 : z * 8 + 8]).all()
    for at in np.ndindex(n, n, n):
        entry = int(grid.table.reshape(n, n, n)[at])
        if entry < 0:
            nearest = np.abs(grid.slot_coords - at).max(axis=1).min(initial=MAX_DISTANCE)
            assert -entry == min(nearest, MAX_DISTANCE)


def test_the_table_of_many_places_says_how_far_the_nearest_brick_is() -> None:
    """Places without a brick hold the distance to the nearest one, up to MAX_DISTANCE. Here an axis has more
    places than that, and its resolution is no multiple of eight."""
    cells = 8 * np.array([[1, 2, 3], [1, 2, 12], [4, 21, 0]]) + 3
    coords, masks, order = pack_vertices((cells[:, None] + list(np.ndindex(2, 2, 2))).reshape(-1, 3))
    one = VertexBricks(coords, masks, np.ones(len(order), np.uint8))
    grid = build_grid(
        from_vertices(one, 355), from_vertices(one, 355), np.array([[-1] * 3, [1] * 3]), 0.1, (1,), (0, 1)
    )
    n = grid.n_per_axis
    assert n == 45 > MAX_DISTANCE
    away = np.abs(np.indices((n, n, n)).reshape(3, 1, -1) - grid.slot_coords.T[:, :, None]).max(axis=0)
    nearest = np.minimum(away.min(axis=0), MAX_DISTANCE)
    assert nearest.max() == MAX_DISTANCE < away.min(axis=0).max()
    assert (np.maximum(-grid.table, 0) == nearest).all()


def test_grid_of_the_asset_keeps_every_vertex(asset: Asset) -> None:
    stored = asset.arrays.features
    assert stored.pyramid.vertices[0].n == len(asset.grid.features)
    assert (asset.grid.features == stored.values[0]).all()


def test_features_are_read_as_the_format_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The grid gives the features that the reader in docs/format.md does, also where no level has a brick."""
    monkeypatch.chdir(tmp_path)
    asset = Asset.open(write_in_parts(Path("out")))
    text = (Path(__file__).parents[3] / "docs" / "format.md").read_text(encoding="utf-8")
    reader = text.split("## A reader")[1].split("```python\n")[1].split("\nframe = ")[0]  # it renders nothing
    names: dict[str, Any] = {}
    exec(compile(reader, "docs/format.md", "exec"), names)
    (low, high), m = np.array(asset.manifest.aabb), asset.manifest
    bare = 0
    for share in np.random.default_rng(0).uniform(0, 1, (2000, 3)):
        place = low + share * (high - low)
        values, (total,) = stored_features(asset.grid, (share[:, None] * m.resolution).astype(np.float32))
        value, wanted = names["feature"](place)
        assert abs(total - wanted) < 1e-4 and np.abs(values[0] - value * wanted).max() < 1e-2, share
        bare += names["read"](names["features"], m.feature_resolution, place)[0] is None
    assert bare > 20
