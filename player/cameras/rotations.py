"""The rotation between the camera axes of OpenGL and OpenCV, and rotations as unit quaternions (w, x, y,
z)."""

from __future__ import annotations

import numpy as np

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Matrix [4, 4] from OpenCV's camera axes (x right, y down, looks along +z) to OpenGL's (x right, y up, looks
along -z). It is its own inverse: `c2w @ OPENGL_FROM_OPENCV` turns a pose of either kind into the other."""


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion [4] (w, x, y, z) of a rotation [3, 3]; its first component that is not 0 is
    positive.

    It is computed from the largest of its four components (Shepperd 1978), so that no rotation suffers from
    rounding.

    >>> quaternion(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])).round(4).tolist()
    [0.7071, 0.0, 0.0, 0.7071]
    """
    r = np.asarray(rotation, np.float64)
    trace = float(np.trace(r))
    squares = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    largest = int(np.argmax(squares))
    if largest == 0:
        q = np.array([1 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = r[k, j] - r[j, k]
        q[1 + i] = 1 + r[i, i] - r[j, j] - r[k, k]
        q[1 + j] = r[j, i] + r[i, j]
        q[1 + k] = r[k, i] + r[i, k]
    q /= np.linalg.norm(q)
    first = q[np.flatnonzero(np.abs(q) > 1e-12)[0]]
    return (q if first > 0 else -q) + 0.0  # no negative zeros


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
