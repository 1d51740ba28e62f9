"""Contraction of all of space into a ball, as in mip-NeRF 360 (Barron et al. 2022, eq. 10).

Notation: c(x) = x inside the unit ball, (2 - 1/r) x / r outside, with r = |x|. At r = 1 the two formulas
agree, and so do their slopes along x. Points are given as x = v / h with a divisor h >= 0: h = 0 is infinity
in the direction v, and nothing overflows on the way there. With q = |v|, c(x) = v / h where q <= h, else (2 -
h/q) v / q. The inverse of c is never needed.
"""

from __future__ import annotations

import numpy as np


def contraction_scale(norm: np.ndarray, divisor: np.ndarray) -> np.ndarray:
    """Return the factor [...] by which v is multiplied to contract v / h, from q = |v| and the divisor h,
    both [...] and not both 0."""
    inside = norm <= divisor
    q, h = np.where(inside, 1, norm).astype(norm.dtype), np.where(inside, divisor, 1).astype(norm.dtype)
    return np.where(inside, 1 / h, (2 - divisor / q) / q)


def pull_back(gradients: np.ndarray, v: np.ndarray, divisor: np.ndarray) -> np.ndarray:
    """Turn gradients in contracted space into gradients in space: the transposed Jacobian of c times each.

    Outside the unit ball, c scales by (2 - 1/r) / r across the direction of x and by 1/r^2 along it.

    Args:
        gradients: [3, n] with respect to c(x).
        v: [3, n] and divisor [n]: the points x = v / h.

    Returns:
        [3, n] with respect to x.

    >>> pull_back(np.array([[1.0], [1.0], [0.0]]), np.array([[2.0], [0.0], [0.0]]), np.ones(1))[:, 0].tolist()
    [0.25, 0.75, 0.0]
    """
    norm = np.sqrt(np.sum(v * v, axis=0))
    outside = norm > divisor
    q = np.where(outside, norm, 1)
    inverse = np.where(outside, divisor / q, 1)  # 1 / r
    unit = v / q
    along = np.sum(unit * gradients, axis=0)
    across = (2 - inverse) * inverse
    return np.where(outside, across * gradients + (inverse * inverse - across) * along * unit, gradients)
