"""Marking of the cells, of an object's box or of contracted space, in which samples of rays have weight."""

from __future__ import annotations

import numpy as np
from numba import prange

from vfr_bake.kernels import njit
from vfr_bake.kernels.contraction import contracted_at
from vfr_bake.kernels.density import look_up
from vfr_bake.kernels.hash_grid import FLAGS, cell_of
from vfr_bake.kernels.march import next_sample, ray_box


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def render_and_mark(rays_o, rays_d, step, distance, field, limits, weight_floors, visible, out, opacity):
    """Composite features along rays as `vfr_bake.kernels.march.render_features` does, and set `visible`
    [r, r, r, n] (uint8) to 1 for the cells in which some ray has a sample whose weight is at least
    `weight_floors[i]`, for each of the n floors. If `out` is [n_rays, 0], cells are marked without features.

    Several threads may set one cell. All write the same 1, so the result does not depend on their order.
    """
    kind = rays_o.dtype.type
    half = kind(0.5)
    cells, last = kind(visible.shape[0]), np.int32(visible.shape[0] - 1)
    block = 64
    n_rays = rays_o.shape[0]
    for start in prange((n_rays + block - 1) // block):
        hidden = np.zeros(field.b1.shape[0], rays_o.dtype)
        feature = np.zeros(2 * field.scales.shape[0], rays_o.dtype)
        for ray in range(start * block, min((start + 1) * block, n_rays)):
            t_near, t_far = ray_box(rays_o, rays_d, ray)
            tau = kind(0)
            i = np.int64(0)
            while tau <= limits.opaque_depth:
                i, _, ux, uy, uz = next_sample(rays_o, rays_d, ray, t_near, t_far, i, half, step, distance)
                if i < 0:
                    break
                i += 1
                delta = look_up(ux, uy, uz, field, limits, feature, hidden) * step
                weight = -np.exp(-tau) * np.expm1(-delta)
                for c in range(out.shape[1]):
                    out[ray, c] += weight * feature[c]
                for level in range(weight_floors.shape[0]):
                    if weight >= weight_floors[level]:
                        x, y, z = (
                            cell_of(ux * cells, last), cell_of(uy * cells, last), cell_of(uz * cells, last)
                        )  # fmt: skip
                        visible[x, y, z, level] = 1
                tau += delta
            opacity[ray] = -np.expm1(-tau)


@njit(parallel=True, cache=True, error_model="numpy")
def mark_weighty_cells(rays_o, rays_d, t_mid, deltas, weights, starts, counts, weight_floor, visible):
    """Set `visible` [r, r, r] (uint8) to 1 for the cells in which the intervals of some ray have a total
    weight of at least `weight_floor`.

    Ray i has the intervals `starts[i]` to `starts[i] + counts[i]`. An interval that is longer than half a
    cell is cut into parts of equal disparity, because long intervals are spaced by disparity. Several threads
    may set one cell: all write the same 1.
    """
    r = visible.shape[0]
    cells, last = np.float32(r), np.int32(r - 1)
    one, half = np.float32(1), np.float32(0.5)
    for ray in prange(rays_o.shape[0]):
        cell, inside = np.int64(-1), np.float32(0)
        for j in range(starts[ray], starts[ray] + counts[ray]):
            near, far = t_mid[j] - half * deltas[j], t_mid[j] + half * deltas[j]
            # At least one part for each half cell: a length in contracted space is at most that in disparity.
            s0, s1 = near / (one + near), far / (one + far)
            n = np.int64((s1 - s0) * np.float32(2 * r)) + 1
            for part in range(n):
                s = s0 + (s1 - s0) * (np.float32(part) + half) / np.float32(n)
                t = s / (one - s)
                ux, uy, uz = contracted_at(rays_o, rays_d, ray, t)
                x, y, z = cell_of(ux * cells, last), cell_of(uy * cells, last), cell_of(uz * cells, last)
                here = (np.int64(x) * r + y) * r + z
                if here != cell:
                    cell, inside = here, np.float32(0)
                inside += weights[j] / np.float32(n)
                if inside >= weight_floor:
                    visible[x, y, z] = 1
