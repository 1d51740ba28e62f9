"""Which cells the samples of rays weigh in: cells of an object's box, or of contracted space."""

from __future__ import annotations

import numpy as np
from numba import prange

from vfr_bake.kernels import njit
from vfr_bake.kernels.contraction import contracted_unit
from vfr_bake.kernels.hash_grid import FLAGS, encode_point
from vfr_bake.kernels.march import density_logit, next_sample, ray_box


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def mark_visible_cells(rays_o, rays_d, step, distance, grid, network, limits, weight_floors, visible):
    """Set `visible` [r, r, r, n] (uint8) where a sample of some ray weighs at least each of `weight_floors`
    [n].

    Several threads may set one cell: all write the same 1, so the result does not depend on their order.
    """
    table, scales, offsets, hashed, mask = grid
    w1, b1, w2, b2 = network
    largest_logit, opaque = limits
    kind = table.dtype.type
    half = kind(0.5)
    r = visible.shape[0]
    block = 64
    n_rays = rays_o.shape[0]
    for start in prange((n_rays + block - 1) // block):
        hidden = np.zeros(b1.shape[0], table.dtype)
        feature = np.zeros(2 * scales.shape[0], table.dtype)
        for ray in range(start * block, min((start + 1) * block, n_rays)):
            t_near, t_far = ray_box(rays_o, rays_d, ray)
            tau = kind(0)
            i = 0
            while tau <= opaque:
                i, _, ux, uy, uz = next_sample(rays_o, rays_d, ray, t_near, t_far, i, half, step, distance)
                if i < 0:
                    break
                i += 1
                encode_point(ux, uy, uz, table, scales, offsets, hashed, mask, feature)
                delta = np.exp(min(density_logit(feature, w1, b1, w2, b2, hidden), largest_logit)) * step
                weight = -np.exp(-tau) * np.expm1(-delta)
                for level in range(weight_floors.shape[0]):
                    if weight >= weight_floors[level]:
                        jx = min(max(np.int64(ux * kind(r)), 0), r - 1)
                        jy = min(max(np.int64(uy * kind(r)), 0), r - 1)
                        jz = min(max(np.int64(uz * kind(r)), 0), r - 1)
                        visible[jx, jy, jz, level] = 1
                tau += delta


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
