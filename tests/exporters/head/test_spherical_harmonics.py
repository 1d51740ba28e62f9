"""Tests of the polynomial table against quadrature, scipy's Legendre functions and published constants."""

from __future__ import annotations

import numpy as np
import pytest

from exporters.head.spherical_harmonics import sh_monomials
from player.errors import ConfigError
from tests.numerics.bounds import Row
from tests.reference import spherical_harmonics

HARMONICS = Row("Field", "spherical harmonics in float64", "1 to 8 bands, any direction, the axes", 1e-12)
ORTHONORMAL = Row("Field", "products of two harmonics over the sphere, in float64", "8 bands", 1e-12)


def evaluate(dirs: np.ndarray, degree: int) -> np.ndarray:
    exponents, coefficients = sh_monomials(degree)
    return np.prod(dirs[:, None, :] ** exponents, axis=-1) @ coefficients


def unit_directions(n: int) -> np.ndarray:
    dirs = np.random.default_rng(1).normal(size=(n, 3))
    dirs /= np.linalg.norm(dirs, axis=-1, keepdims=True)
    return np.concatenate([dirs, np.eye(3), -np.eye(3)])


@pytest.mark.parametrize("degree", range(1, 9))
def test_agrees_with_angles_and_legendre_functions(degree: int) -> None:
    # Both sides use the Condon-Shortley sign convention. The bound of 1e-12 allows for powers up to 7 with
    # coefficients up to about 200.
    dirs = unit_directions(200)
    HARMONICS.check(evaluate(dirs, degree), spherical_harmonics(dirs, degree))


def test_orthonormal_on_the_sphere() -> None:
    """The harmonics are orthonormal, by Gauss-Legendre quadrature in z times equal angles, which integrates
    polynomials of order 14 = 2 (8 - 1) exactly."""
    z, weight_z = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * (2 * np.pi / 16)
    z, phi = (axis.ravel() for axis in np.meshgrid(z, phi, indexing="ij"))
    root = np.sqrt(1 - z**2)
    y = evaluate(np.stack([root * np.cos(phi), root * np.sin(phi), z], axis=-1), 8)
    weights = np.repeat(weight_z, 16) * (2 * np.pi / 16)
    ORTHONORMAL.check(y.T @ (weights[:, None] * y), np.eye(64))


def test_constants_of_instant_ngp() -> None:
    x, y, z = dirs = np.array([0.36, 0.48, 0.8])
    expected = [
        0.28209479177387814,
        -0.48860251190291987 * y,
        0.48860251190291987 * z,
        -0.48860251190291987 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.94617469575755997 * z * z - 0.31539156525251999,
        -1.0925484305920792 * x * z,
        0.54627421529603959 * (x * x - y * y),
        0.59004358992664352 * y * (-3 * x * x + y * y),
        2.8906114426405538 * x * y * z,
        0.45704579946446572 * y * (1 - 5 * z * z),
        0.3731763325901154 * z * (5 * z * z - 3),
        0.45704579946446572 * x * (1 - 5 * z * z),
        1.4453057213202769 * z * (x * x - y * y),
        0.59004358992664352 * x * (-x * x + 3 * y * y),
    ]
    np.testing.assert_allclose(evaluate(dirs[None], 4)[0], expected, atol=1e-14)


@pytest.mark.parametrize("degree", [0, 9, -1])
def test_degree_out_of_range(degree: int) -> None:
    with pytest.raises(ConfigError, match="degree: expected 1 to 8"):
        sh_monomials(degree)
