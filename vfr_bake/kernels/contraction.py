"""Scene contraction of mip-NeRF 360 (Barron et al. 2022, eq. 10): it maps all of space into the ball of
radius 2.

c(x) = x inside the unit ball, (2 - 1 / |x|) x / |x| outside; u = (c + 2) / 4 is in the unit cube of the hash
grids. Points are contracted when they are looked up; contracted points are never mapped back.
"""

from __future__ import annotations

import numpy as np

from vfr_bake.kernels import njit
from vfr_bake.kernels.hash_grid import FLAGS


@njit(fastmath=FLAGS, error_model="numpy")
def contracted_unit(x, y, z, one):
    """Return the point of the unit cube for any finite x, y, z of the model frame; `one` is 1 in their
    type."""
    two = one + one
    # Divide by the largest coordinate first: the square of 1e30 would overflow float32.
    largest = max(abs(x), max(abs(y), abs(z)))
    scale = one
    if largest * two > one:
        a, b, c = x / largest, y / largest, z / largest
        norm = largest * np.sqrt(a * a + b * b + c * c)
        if norm > one:
            scale = (two - one / norm) / norm
    half = one / two
    scale *= half * half
    return x * scale + half, y * scale + half, z * scale + half


@njit(inline="always")
def contracted_at(rays_o, rays_d, ray, t):
    """Return the point of the unit cube at distance `t` along number `ray` of `rays_o`, `rays_d`
    [n_rays, 3]."""
    return contracted_unit(
        rays_o[ray, 0] + t * rays_d[ray, 0],
        rays_o[ray, 1] + t * rays_d[ray, 1],
        rays_o[ray, 2] + t * rays_d[ray, 2],
        rays_o.dtype.type(1),
    )
