"""Which cells of contracted space the samples of an unbounded scene weigh in."""

from __future__ import annotations

import numpy as np
from numba import prange

from vfr_bake.kernels import njit
from vfr_bake.kernels.contraction import contracted_unit


@njit(parallel=True, cache=True, error_model="numpy")
def mark_weighty_cells(rays_o, rays_d, t_mid, deltas, weights, starts, counts, weight_floor, visible):
    """Set `visible` [r, r, r] (uint8) where the intervals of some ray weigh at least `weight_floor` in all.

    Ray i has the intervals `starts[i]` to `starts[i] + counts[i]`; one that is longer than half a cell is cut
    into equal parts of disparity, which is how long intervals lie. Several threads may set one cell: all
    write the same 1.
    """
    r = visible.shape[0]
    one, half = np.float32(1), np.float32(0.5)
    for ray in prange(rays_o.shape[0]):
        cell, inside = np.int64(-1), np.float32(0)
        for j in range(starts[ray], starts[ray] + counts[ray]):
            near, far = t_mid[j] - half * deltas[j], t_mid[j] + half * deltas[j]
            # At least as many as it is half cells long: contracted space is never longer than disparity.
            s0, s1 = near / (one + near), far / (one + far)
            n = np.int64((s1 - s0) * np.float32(2 * r)) + 1
            for part in range(n):
                s = s0 + (s1 - s0) * (np.float32(part) + half) / np.float32(n)
                t = s / (one - s)
                x, y, z = contracted_unit(
                    rays_o[ray, 0] + t * rays_d[ray, 0],
                    rays_o[ray, 1] + t * rays_d[ray, 1],
                    rays_o[ray, 2] + t * rays_d[ray, 2],
                    one,
                )
                jx = min(max(np.int64(x * np.float32(r)), 0), r - 1)
                jy = min(max(np.int64(y * np.float32(r)), 0), r - 1)
                jz = min(max(np.int64(z * np.float32(r)), 0), r - 1)
                here = (jx * r + jy) * r + jz
                if here != cell:
                    cell, inside = here, np.float32(0)
                inside += weights[j] / np.float32(n)
                if inside >= weight_floor:
                    visible[jx, jy, jz] = 1
