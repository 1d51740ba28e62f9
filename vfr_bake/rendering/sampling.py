"""Samples of bounded scenes: lattice points in occupied cells, up to where the ray is opaque.

Letters as in `vfr_bake.kernels.march`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from player.march.march import OPAQUE_DEPTH
from vfr_bake.field.field import VfrField
from vfr_bake.kernels import march as kernels
from vfr_bake.rendering.compositing import LIMITS, Samples

if TYPE_CHECKING:
    from vfr_bake.rendering.occupancy import OccupancyGrid


def march(
    field: VfrField,
    occupancy: OccupancyGrid,
    rays_o: Tensor,
    rays_d: Tensor,
    jitter: Tensor,
    budget: int,
    n_chunks: int = 2,
) -> tuple[Samples, np.ndarray]:
    """Samples of as many of the rays [n_rays, 3] as fit into `budget` samples, and the densities [n_samples]
    that the march met there; `jitter` [n_rays] in [0, 1).

    The budget is grown to hold at least one whole ray per chunk.
    """
    step = occupancy.step
    longest = int(np.ceil(2 * 3**0.5 / step)) + 3
    capacity = max(budget // n_chunks, longest)
    n_channels = field.config.n_channels
    t_mid, sigmas = np.empty((2, n_chunks, capacity), np.float32)
    points = np.empty((n_chunks, capacity, 3), np.float32)
    features = np.empty((n_chunks, capacity, n_channels), np.float32)
    counts = np.empty(len(rays_o), np.int64)
    starts = np.empty(len(rays_o), np.int64)
    used = kernels.march_samples(
        rays_o.numpy(), rays_d.numpy(), jitter.numpy(), np.float32(step),
        occupancy.distance,
        *field.kernel_arguments(), LIMITS, counts, starts, t_mid, points, features, sigmas,
    )  # fmt: skip
    first = np.concatenate([[0], np.cumsum(used)])
    served = np.flatnonzero(counts >= 0)
    samples = Samples(
        t_mid=torch.from_numpy(_join(t_mid, used)),
        deltas=torch.full((int(first[-1]),), step),
        points=torch.from_numpy(_join(points, used)),
        features=torch.from_numpy(_join(features, used)),
        rays=torch.from_numpy(served),
        starts=torch.from_numpy(starts[served] + first[served % n_chunks]),
        counts=torch.from_numpy(counts[served]),
    )
    return samples, _join(sigmas, used)


def _join(chunks: np.ndarray, used: np.ndarray) -> np.ndarray:
    return np.concatenate([chunk[:n] for chunk, n in zip(chunks, used, strict=True)])


def march_reference(
    field: VfrField, occupied: np.ndarray, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, step: float
) -> list[Tensor]:
    """The t of every ray's visible samples, ray by ray and lattice point by lattice point: what `march` must
    find."""
    n = len(occupied)
    found = []
    for o, d, offset in zip(rays_o, rays_d, jitter, strict=True):
        crosses = d != 0
        if bool((o[~crosses].abs() > 1).any()):
            found.append(torch.zeros(0))  # parallel to a face that it lies outside of
            continue
        slabs = torch.stack([(-1 - o[crosses]) / d[crosses], (1 - o[crosses]) / d[crosses]])
        t_near = slabs.min(dim=0).values.max().clamp(min=0)
        t_far = slabs.max(dim=0).values.min()
        t = t_near + (torch.arange(int(2 * 3**0.5 / step) + 2) + offset) * step
        t = t[t < t_far]
        u = (o + t[:, None] * d + 1) / 2
        cells = (u * n).long().clamp(0, n - 1)
        t, u = t[occupied[tuple(cells.T)]], u[occupied[tuple(cells.T)]]
        with torch.no_grad():
            sigmas = field.density(field.grid.reference(u))
        before = torch.cumsum(torch.cat([sigmas.new_zeros(1), sigmas * step]), dim=0)[:-1]
        found.append(t[before <= OPAQUE_DEPTH])
    return found
