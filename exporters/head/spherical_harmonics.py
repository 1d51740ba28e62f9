"""Real spherical harmonics as polynomials of a unit direction (x, y, z).

Y_lm = K_lm Q_l^|m|(z) * { Re (x + iy)^m  for m >= 0,  Im (x + iy)^|m|  for m < 0 }, where Q_l^m(z) = P_l^m(z)
/ (1 - z^2)^(m/2) is the associated Legendre function without its root, Condon-Shortley phase (-1)^m included,
and K_lm^2 = (2l + 1) / (4 pi) (l - |m|)! / (l + |m|)! (times 2 for m != 0). Order: index = l^2 + l + m. It is
the convention of instant-ngp and tiny-cuda-nn: Y = 0.2820948, -0.4886025 y, 0.4886025 z, -0.4886025 x,
1.0925485 xy, ... The training and the ONNX head both read this one table, so that they cannot disagree on
order or sign.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import Legendre
from numpy.polynomial import Polynomial as PowerSeries

from player.errors import ConfigError

MAX_DEGREE = 8

Polynomial = dict[tuple[int, int, int], float]
"""{(power of x, power of y, power of z): coefficient}."""


def sh_monomials(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the bands l = 0 .. degree - 1 as monomials and their coefficients: Y(d) = prod(d **
    exponents) @ coefficients.

    Args:
        degree: number of bands, 1 to 8; there are degree^2 bases.

    Returns:
        exponents [n_monomials, 3] int64, powers of x, y and z, sorted by their sum: the constant comes first;
        coefficients [n_monomials, degree^2] float64.

    Raises:
        ConfigError: degree out of range.

    >>> exponents, coefficients = sh_monomials(2)
    >>> exponents.tolist()
    [[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]]
    >>> coefficients.round(4).tolist()[2]
    [0.0, -0.4886, 0.0, 0.0]
    """
    if not 1 <= degree <= MAX_DEGREE:
        raise ConfigError(f"spherical harmonics: degree: expected 1 to {MAX_DEGREE}, got {degree}")
    bases = [_harmonic(order, m) for order in range(degree) for m in range(-order, order + 1)]
    exponents = sorted(
        {powers for basis in bases for powers in basis}, key=lambda powers: (sum(powers), powers)
    )
    coefficients = np.array([[basis.get(powers, 0.0) for basis in bases] for powers in exponents])
    return np.array(exponents), coefficients


def _harmonic(order: int, m: int) -> Polynomial:
    k = math.sqrt(
        (2 * order + 1) / (4 * math.pi) * math.factorial(order - abs(m)) / math.factorial(order + abs(m))
    )
    if m:
        k *= math.sqrt(2)
    # Q_l^m is the m-th derivative of the Legendre polynomial P_l, whose coefficients are whole sixteenths
    p = Legendre.basis(order).convert(kind=PowerSeries).coef
    q = (-1) ** m * PowerSeries(np.rint(16 * p) / 16).deriv(abs(m)).coef
    return {
        (power_x, power_y, power_z): k * float(legendre) * circular
        for power_z, legendre in enumerate(q)
        for (power_x, power_y), circular in _circular(m).items()
        if legendre
    }


def _circular(m: int) -> dict[tuple[int, int], int]:
    """Return Re (x + iy)^m for m >= 0, Im (x + iy)^|m| for m < 0, as coefficients by powers of x and y."""
    result = {}
    for power_y in range(1 if m < 0 else 0, abs(m) + 1, 2):
        result[abs(m) - power_y, power_y] = (-1) ** (power_y // 2) * math.comb(abs(m), power_y)
    return result
