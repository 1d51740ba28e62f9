"""Contraction, spherical harmonics and hash grid at their ends, compared with mpmath and float64 loops."""

from __future__ import annotations

import math
from functools import partial

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from exporters.head.spherical_harmonics import MAX_DEGREE, sh_monomials
from tests.numerics.bounds import Row
from tests.reference import hash_grid_feature, spherical_harmonics
from tests.vfr_bake import twins
from vfr_bake.config import FieldConfig
from vfr_bake.field.hash_grid import HashGrid
from vfr_bake.field.networks import SphericalHarmonics
from vfr_bake.kernels.contraction import contracted_unit
from vfr_bake.kernels.hash_grid import corner_rows
from vfr_bake.torch_kernels.hash_grid import encode
from vfr_bake.torch_kernels.proposals import contracted_unit as contracted_torch

mpmath.mp.dps = 50
ONE = np.float32(1)
UNIT = 2.0**-24
DTYPES = [
    pytest.param(dtype, id=str(dtype).removeprefix("torch.")) for dtype in (torch.float32, torch.float64)
]

CONTRACTION = Row(
    "Field", "contraction", "any finite point", 4, "u of the unit cube",
    "0, `nextafter` of the unit sphere on both sides, 1e19 (whose square overflows), 1e30, 3e38;"
    " may lie 2u outside the cube",
)  # fmt: skip
OUTSIDE = Row(
    "Field", "hash grid 2u outside the cube", "levels to N = 4,096 cells", 12, "N u of an entry",
    "indices are clamped to the last cell",
)  # fmt: skip
HARMONICS = Row(
    "Field", "spherical harmonics in float32", "1 to 8 bands, at the poles and beside them", 2e-5,
    at_ends="at the poles only m = 0 is left, exactly in float64",
)  # fmt: skip
ORTHONORMAL = Row("Field", "products of two harmonics over the sphere, in float32", "8 bands", 1e-4)
HASH_GRID = Row(
    "Field", "hash grid", "unit cube, levels to N = 4,096 cells", 24, "N u of an entry",
    "0, 1, cell borders and the numbers beside them;"
    " at 4,096 cells a float32 position has 12 bits left within a cell",
)  # fmt: skip
JUMP = Row(
    "Field", "hash grid from one side of a cell's border to the other", "N = 4,096", 16, "N u of an entry",
    "the places are 2 ulp apart: no jump",
)  # fmt: skip
TABLE_GRADIENT = Row("Field", "gradient of the hash grid's table in float64", "at borders", 1e-12)
HASH = Row(
    "Field", "hash", "vertices to 2^21 an axis", unit="exact",
    at_ends="products past 2^31 and 2^53 are whole numbers below 2^63",
)  # fmt: skip


def exact_contraction(point: tuple[float, ...]) -> list[float]:
    """Return u = (c(x) + 2) / 4 with 50 digits."""
    x = [mpmath.mpf(c) for c in point]
    norm = mpmath.sqrt(mpmath.fsum(c * c for c in x))
    scale = mpmath.mpf(1) if norm <= 1 else (2 - 1 / norm) / norm
    return [float((c * scale + 2) / 4) for c in x]


AROUND_ONE = [float(np.nextafter(ONE, np.float32(side))) for side in (0, 2)]
SIZES = [0.0, 1e-45, 1e-38, 1e-20, 0.5, *AROUND_ONE, 1.0, 2.0, 1e4, 1e15, 1e19, 1e20, 1e30, 3e38]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    "direction", [(1, 0, 0), (0, -1, 0), (0.6, 0, -0.8), (-0.5, 0.5, 0.70710678)], ids=str
)
def test_contraction_is_equation_10_with_50_digits(size: float, direction: tuple[float, ...]) -> None:
    point = np.float32(np.array(direction) * size)
    wanted = exact_contraction(tuple(point.tolist()))
    numba = contracted_unit(*point, ONE)
    torched = contracted_torch(torch.from_numpy(point)[None])[0].tolist()
    for ours in (numba, torched):
        CONTRACTION.check(ours, wanted, of=UNIT)
        assert all(-UNIT <= c <= 1 + 2 * UNIT for c in ours), "lookups clamp the cell, see below"


@given(st.tuples(*[st.floats(-2, 2, width=32)] * 3))
def test_contraction_keeps_the_order_along_a_ray(point: tuple[float, ...]) -> None:
    """A point twice as far away is contracted farther out, also across the unit sphere."""
    assume(math.hypot(*point) >= 1e-3)
    once = contracted_unit(*np.float32(point), ONE)
    twice = contracted_unit(*np.float32([2 * c for c in point]), ONE)
    size = [math.dist(u, (0.5, 0.5, 0.5)) for u in (once, twice)]
    assert size[0] <= size[1] + 4 * UNIT and size[1] <= 0.5 + 4 * UNIT


POLES = np.concatenate([np.eye(3), -np.eye(3)])
NEAR_POLES = np.array([[1e-8, 0, 1], [0, -1e-20, -1], [1e-30, 1e-30, 1], [-0.0, 0.0, 1.0]])


@pytest.mark.parametrize("degree", range(1, MAX_DEGREE + 1))
def test_harmonics_at_the_poles(degree: int) -> None:
    """At a pole only m = 0 is left. torch's float32 is within 2e-5 of float64, because coefficients are up to
    200 and powers up to 7."""
    dirs = np.concatenate([POLES, NEAR_POLES])
    exponents, coefficients = sh_monomials(degree)
    ours = np.prod(dirs[:, None, :] ** exponents, axis=-1) @ coefficients
    np.testing.assert_allclose(ours, spherical_harmonics(dirs, degree), rtol=0, atol=1e-7)
    single = SphericalHarmonics(degree)(torch.from_numpy(dirs).float()).double().numpy()
    HARMONICS.check(single, ours)
    for row in (ours[2], ours[5]):
        others = [row[band * band + band + m] for band in range(degree) for m in range(-band, band + 1) if m]
        assert not np.any(others)


def test_harmonics_are_orthonormal_in_float32() -> None:
    """Harmonics as in training are orthonormal, by a quadrature in float64 that is exact for products."""
    z, weight_z = np.polynomial.legendre.leggauss(MAX_DEGREE)
    phi = np.arange(2 * MAX_DEGREE) * (np.pi / MAX_DEGREE)
    z, phi = (axis.ravel() for axis in np.meshgrid(z, phi, indexing="ij"))
    root = np.sqrt(1 - z**2)
    dirs = np.stack([root * np.cos(phi), root * np.sin(phi), z], axis=-1)
    y = SphericalHarmonics(MAX_DEGREE)(torch.from_numpy(dirs).float()).double().numpy()
    weights = np.repeat(weight_z, 2 * MAX_DEGREE) * (np.pi / MAX_DEGREE)
    ORTHONORMAL.check(y.T @ (weights[:, None] * y), np.eye(MAX_DEGREE**2))


def small_grid(dtype: torch.dtype, resolution: int) -> HashGrid:
    torch.manual_seed(3)
    config = FieldConfig(n_levels=3, base_resolution=4, max_resolution=resolution, log2_table_size=12)
    grid = HashGrid(config).to(dtype)
    torch.nn.init.uniform_(grid.table, -1, 1)
    return grid


def hard_coordinates(resolution: int) -> list[float]:
    """Return 0, 1, cell borders, and the numbers next to these."""
    borders = [0.0, 1 / resolution, 0.25, 0.5, (resolution - 1) / resolution, 1.0]
    beside = [float(np.nextafter(np.float32(b), np.float32(to))) for b in borders for to in (0, 1)]
    return sorted({float(np.float32(c)) for c in [*borders, *beside, 1e-45, 1e-30]})


@pytest.mark.parametrize("resolution", [40, 512, 4096])
@pytest.mark.parametrize("dtype", DTYPES)
def test_hash_grid_at_borders(dtype: torch.dtype, resolution: int) -> None:
    """At borders, features are exact for the rounded position, which is off by N 2^-24 cells for N cells."""
    grid = small_grid(dtype, resolution)
    some = hard_coordinates(resolution)
    random = np.random.default_rng(0)
    points = np.stack([random.permutation(some) for _ in range(3)], axis=1)
    points = np.concatenate([points, np.repeat(np.array(some)[:, None], 3, axis=1)])
    table = grid.table.detach().double().numpy()
    layout = grid.layout
    wanted = np.stack(
        [hash_grid_feature(p, table, layout.resolutions, layout.offsets, 2**12) for p in points]
    )
    tensor = torch.from_numpy(points).to(dtype)
    unit = torch.finfo(dtype).eps
    for ours in (
        grid(tensor),
        twins.encode(grid, tensor),
        encode(tensor, grid.table, layout.levels(grid.table)),
    ):
        HASH_GRID.check(ours.detach(), wanted, of=unit / 2 * resolution)


def test_hash_grid_does_not_jump_at_a_cell_border() -> None:
    """Features on both sides of a border of the finest level differ by the step times the slope at most."""
    grid = small_grid(torch.float32, 4096)
    borders = np.arange(1, 4096, 7, dtype=np.float64) / 4096
    sides = []
    for to in (0, 1):
        x = np.nextafter(borders.astype(np.float32), np.float32(to))
        sides.append(grid(torch.from_numpy(np.stack([x, np.full_like(x, 0.3), np.full_like(x, 0.7)], 1))))
    # two ulps apart, entries within 1, roundings of two axes
    JUMP.check((sides[0] - sides[1]).detach(), of=4096 * UNIT)


def test_points_a_rounding_outside_the_cube_are_served_from_its_last_cell() -> None:
    """Points 2^-24 outside, which contraction makes of very distant points, have the last cell's features."""
    grid = small_grid(torch.float32, 4096)
    inside = torch.tensor([[0.0, 1.0, 0.5], [1.0, 1.0, 0.0]])
    outside = torch.tensor([[-UNIT, 1 + 2 * UNIT, 0.5], [1 + 2 * UNIT, 1.0, -UNIT]])
    table = grid.table
    for function in (
        grid,
        partial(twins.encode, grid),
        lambda x: encode(x, table, grid.layout.levels(table)),
    ):
        OUTSIDE.check((function(outside) - function(inside)).detach(), of=4096 * UNIT)


def test_gradient_of_the_table_at_borders_is_autograds() -> None:
    grid = small_grid(torch.float64, 512)
    coordinates = torch.tensor(hard_coordinates(512), dtype=torch.float64)
    points = torch.stack([coordinates, coordinates.flip(0), coordinates], dim=1)
    upstream = torch.randn(len(points), 6, dtype=torch.float64)
    grads = [
        torch.autograd.grad(values, grid.table, upstream)[0]
        for values in (grid(points), twins.encode(grid, points))
    ]
    TABLE_GRADIENT.check(grads[0], grads[1])


def test_hashes_past_2_to_the_31_are_those_of_whole_numbers() -> None:
    """Hashes are x xor y 2654435761 xor z 805459861 in Python's integers, even if products need 53 bits."""
    size = 2**12
    vertices = [(0, 0, 0), (1, 2**20, 2**20), (2**20, 2**20 - 1, 1), (2**21, 2**21, 2**21 - 1)]
    grid = small_grid(torch.float32, 4096)
    level = 2
    assert grid.layout.hashed[level]
    first = int(grid.layout.offsets[level])
    for x, y, z in vertices:
        rows = corner_rows(x, y, z, 2**21, first, grid.layout.mask, True)
        for corner, row in enumerate(rows):
            a, b, c = x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2 & 1)
            HASH.holds(int(row) - first == (a ^ (b * 2654435761) ^ (c * 805459861)) % size)
        assert max(y * 2654435761, z * 805459861) < 2**63
