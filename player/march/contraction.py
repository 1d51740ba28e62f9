"""All of space in a ball: the contraction of mip-NeRF 360 (Barron et al. 2022, eq. 10).

Letters: c(x) = x inside the unit ball, (2 - 1/r) x / r outside, with r = |x|; at its border both are x, and
so is the slope along x. Points come as x = v / h with a divisor h >= 0, so that infinity in the direction v
is h = 0 and nothing overflows on the way there: with q = |v|, c(x) = v / h where q <= h, else (2 - h/q) v /
q. A contracted point is never turned back.
"""

from __future__ import annotations

import numpy as np


def contract(points: np.ndarray, divisor: np.ndarray | float = 1.0) -> np.ndarray:
    """Where points are in contracted space.

    Args:
        points: [..., 3] float32 or float64, any size; a coordinate may be infinite.
        divisor: [...] >= 0, what the points are to be divided by; 0 is infinitely far away in the direction
            of the point, which must not be 0 then.

    Returns:
        [..., 3] in the type of `points`, inside the ball of radius 2.

    >>> contract(np.array([[0.5, 0, 0], [0, 4, 0], [0, 0, -np.inf]])).tolist()
    [[0.5, 0.0, 0.0], [0.0, 1.75, 0.0], [0.0, 0.0, -2.0]]
    """
    infinite = np.isinf(points)
    endless = np.asarray(infinite.any(axis=-1))
    v = np.where(endless[..., None], np.copysign(infinite, points), points).astype(points.dtype)
    h = np.where(endless, 0, divisor).astype(points.dtype)
    largest = np.maximum(
        np.abs(v).max(axis=-1), h
    )  # divided by it first: the square of 1e30 is beyond float32
    largest = np.where(largest > 0, largest, 1)
    v, h = v / largest[..., None], h / largest
    return v * contraction_scale(np.sqrt(np.sum(v * v, axis=-1)), h)[..., None]


def contraction_scale(norm: np.ndarray, divisor: np.ndarray) -> np.ndarray:
    """The factor [...] by which v is multiplied, from q = |v| and the divisor h, [...] and not both 0."""
    inside = norm <= divisor
    q, h = np.where(inside, 1, norm).astype(norm.dtype), np.where(inside, divisor, 1).astype(norm.dtype)
    return np.where(inside, 1 / h, (2 - divisor / q) / q)


def pull_back(gradients: np.ndarray, v: np.ndarray, divisor: np.ndarray) -> np.ndarray:
    """Gradients in contracted space as gradients in space: the transposed Jacobian of c times each.

    Outside, c stretches by (2 - 1/r) / r across x and by 1/r^2 along it.

    Args:
        gradients: [3, n] with respect to c(x).
        v: [3, n] and divisor [n]: the points x = v / h, as `contract` takes them.

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
