"""Samples of rays in an object's box: lattice points in occupied cells, up to where the ray is opaque.

Letters as in `vfr_bake.kernels.march`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from player.march.march import OPAQUE_DEPTH
from vfr_bake.field.field import VfrField
from vfr_bake.kernels.density import LIMITS
from vfr_bake.kernels.march import march_samples
from vfr_bake.rendering.compositing import RaySamples
from vfr_bake.torch_kernels import fast
from vfr_bake.torch_kernels.compositing import sums_before
from vfr_bake.torch_kernels.march import lattice

LATTICE_POINTS = 2**22
"""Lattice points held at once on a GPU, at about 80 bytes each."""
LOOKUP_POINTS = 2**18
"""Points looked up at once on a GPU; without compilation they take 3.5 kB each, with 16 levels."""

Lookup = Callable[[Tensor], tuple[Tensor, Tensor]]
"""A function from points [n, 3] of the unit cube to features [n, n_channels] and densities [n] there."""


def most_samples(step: float) -> int:
    """Return the most samples that a ray can have in the box [-1, 1]^3, plus a few to allow for rounding."""
    return int(np.ceil(2 * 3**0.5 / step)) + 3


def march(
    field: VfrField,
    distance: np.ndarray,
    step: float,
    rays_o: Tensor,
    rays_d: Tensor,
    jitter: Tensor,
    budget: int,
    n_chunks: int = 2,
) -> RaySamples:
    """Return the samples of as many of the rays [n_rays, 3] as fit into `budget` samples; `jitter` [n_rays]
    is in [0, 1).

    The budget is raised if it cannot hold at least one whole ray per chunk.
    """
    capacity = max(budget // n_chunks, most_samples(step))
    n_channels = field.config.n_channels
    t_mid, sigmas = np.empty((2, n_chunks, capacity), np.float32)
    points = np.empty((n_chunks, capacity, 3), np.float32)
    features = np.empty((n_chunks, capacity, n_channels), np.float32)
    counts = np.empty(len(rays_o), np.int64)
    starts = np.empty(len(rays_o), np.int64)
    used = march_samples(
        rays_o.numpy(), rays_d.numpy(), jitter.numpy(), np.float32(step), distance, field.arrays(), LIMITS,
        counts, starts, t_mid, points, features, sigmas,
    )  # fmt: skip
    first, served = np.concatenate([[0], np.cumsum(used)]), np.flatnonzero(counts >= 0)
    return RaySamples(
        t_mid=torch.from_numpy(_join(t_mid, used)),
        deltas=torch.full((int(first[-1]),), step),
        points=torch.from_numpy(_join(points, used)),
        features=torch.from_numpy(_join(features, used)),
        rays=torch.from_numpy(served),
        starts=torch.from_numpy(starts[served] + first[served % n_chunks]),
        counts=torch.from_numpy(counts[served]),
        sigmas=torch.from_numpy(_join(sigmas, used)),
    )


def _join(chunks: np.ndarray, used: np.ndarray) -> np.ndarray:
    return np.concatenate([chunk[:n] for chunk, n in zip(chunks, used, strict=True)])


@torch.no_grad()
def march_on_device(
    lookup: Lookup, occupied: Tensor, step: float, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, budget: int
) -> RaySamples:
    """Return the samples of as many of the rays [n_rays, 3] as fit into `budget` samples; `jitter` [n_rays]
    is in [0, 1).

    In contrast to `march`, a ray is served if its visible samples fit, whose number is known here,
    and not only if the most samples that it could have would fit. The budget is raised if it cannot
    hold at least one whole ray.
    """
    longest = most_samples(step)
    capacity, block = max(budget, longest), max(1, LATTICE_POINTS // longest)
    found, n_found = [], 0
    for start in range(0, max(len(rays_o), 1), block):
        rows = slice(start, start + block)
        found.append(_march_block(lookup, occupied, step, rays_o[rows], rays_d[rows], jitter[rows], longest))
        n_found += len(found[-1][1])
        if n_found > capacity:
            break  # rays of later blocks would not fit
    counts, t_mid, points, features, sigmas = (torch.cat(parts) for parts in zip(*found, strict=True))
    ends = torch.cumsum(counts, dim=0)
    n_served = int((ends <= capacity).sum())
    counts = counts[:n_served]
    n = int(ends[n_served - 1]) if n_served else 0
    return RaySamples(
        t_mid=t_mid[:n],
        deltas=torch.full_like(t_mid[:n], step),
        points=points[:n],
        features=features[:n],
        rays=torch.arange(n_served, device=rays_o.device),
        starts=ends[:n_served] - counts,
        counts=counts,
        sigmas=sigmas[:n],
    )


def _march_block(
    lookup: Lookup,
    occupied: Tensor,
    step: float,
    rays_o: Tensor,
    rays_d: Tensor,
    jitter: Tensor,
    longest: int,
) -> tuple[Tensor, ...]:
    """Return (counts [n_rays], t, points, features, densities) of the visible samples of a block of rays."""
    t, u, candidate = fast(lattice, rays_o.device)(rays_o, rays_d, jitter, occupied, step, longest)
    places = candidate.reshape(-1).nonzero()[:, 0]
    points = u.reshape(-1, 3)[places]
    looked_up = [lookup(part) for part in points.split(LOOKUP_POINTS)]
    features, sigmas = (torch.cat(parts) for parts in zip(*looked_up, strict=True))
    depths = t.new_zeros(t.numel()).scatter(0, places, sigmas.to(t.dtype) * step).reshape(t.shape)
    visible = candidate & (sums_before(depths) <= OPAQUE_DEPTH)
    kept = visible.reshape(-1)[places]
    return visible.sum(dim=1), t.reshape(-1)[places][kept], points[kept], features[kept], sigmas[kept]
