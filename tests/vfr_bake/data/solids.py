"""The box of the built-in scene, and distances from its surface, in world units."""

from __future__ import annotations

import numpy as np

from vfr_bake.data.demo_solids import CENTRE, HIGH, LOW, SCALE, scene_distance

AABB = np.stack([CENTRE + SCALE * LOW, CENTRE + SCALE * HIGH])
"""[2, 3]: the tight box of the whole scene."""


def signed_distance(points: np.ndarray) -> np.ndarray:
    """Return the distances [n] of `points` [n, 3] from the nearest surface, negative inside; they are exact
    outside, and inside, where solids touch, they are bounds with the right sign."""
    p = (np.asarray(points, np.float64).reshape(-1, 3).T - CENTRE[:, None]) / SCALE
    return scene_distance(p) * SCALE
