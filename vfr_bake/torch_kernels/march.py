"""The march through the occupancy grid in torch: every lattice point of a block of rays at once.

Letters as in `vfr_bake.kernels.march`: samples of a ray lie at t_i = t_near + (i + jitter) * step, u = (x +
1) / 2. Nothing is skipped on the way: to test a cell costs a GPU less than to tell its threads apart.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from player.march.march import OPAQUE_DEPTH
from vfr_bake.rendering.compositing import Samples
from vfr_bake.torch_kernels import fast
from vfr_bake.torch_kernels.compositing import sums_before

LATTICE_POINTS = 2**22
"""Lattice points held at once: about 80 bytes each."""
LOOKUP_POINTS = 2**18
"""Points looked up at once: without compilation 3.5 kB each, with 16 levels."""

Lookup = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Of points [n, 3] of the unit cube the (features [n, n_channels], densities [n])."""


def ray_box(rays_o: Tensor, rays_d: Tensor) -> tuple[Tensor, Tensor]:
    """Entry and exit [n_rays] of rays [n_rays, 3] in [-1, 1]^3, entry at least 0; entry >= exit where one
    misses.

    >>> ray_box(torch.tensor([[-3.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
    (tensor([2.]), tensor([4.]))
    """
    crosses = rays_d != 0
    divisor = torch.where(crosses, rays_d, torch.ones_like(rays_d))
    a, b = (-1 - rays_o) / divisor, (1 - rays_o) / divisor
    outside = ~crosses & (rays_o.abs() > 1)  # parallel to a face that it lies outside of
    low = torch.where(crosses, torch.minimum(a, b), torch.zeros_like(a))
    high = torch.where(crosses, torch.maximum(a, b), torch.full_like(a, 1e30))
    high = torch.where(outside, torch.full_like(a, -1), high)
    return low.amax(dim=1).clamp(min=0), high.amin(dim=1)


def lattice(
    rays_o: Tensor, rays_d: Tensor, jitter: Tensor, occupied: Tensor, step: float, n_points: int
) -> tuple[Tensor, Tensor, Tensor]:
    """(t, u, whether it is inside the box and its cell is `occupied` [n, n, n]) of the first `n_points`
    lattice points of rays [n_rays, 3]: [n_rays, n_points], [n_rays, n_points, 3] and [n_rays, n_points]."""
    t_near, t_far = ray_box(rays_o, rays_d)
    numbers = torch.arange(n_points, device=rays_o.device)
    t = t_near[:, None] + (numbers + jitter[:, None]) * step
    u = (rays_o[:, None] + t[..., None] * rays_d[:, None]) * 0.5 + 0.5
    n = occupied.shape[0]
    x, y, z = (u * n).long().clamp(0, n - 1).unbind(-1)
    inside = (t < t_far[:, None]) & (t_near < t_far)[:, None]
    return t, u, inside & occupied.reshape(-1)[(x * n + y) * n + z]


@torch.no_grad()
def march(
    lookup: Lookup, occupied: Tensor, step: float, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, budget: int
) -> tuple[Samples, Tensor]:
    """Samples of as many of the rays [n_rays, 3] as fit into `budget` samples, and the densities [n_samples]
    there; `jitter` [n_rays] in [0, 1).

    As `vfr_bake.rendering.sampling.march`, but that a ray is served if its visible samples fit, known here,
    and not the most that it could have had. The budget is grown to hold at least one whole ray.
    """
    longest = int(np.ceil(2 * 3**0.5 / step)) + 3
    capacity, block = max(budget, longest), max(1, LATTICE_POINTS // longest)
    found, n_found = [], 0
    for start in range(0, max(len(rays_o), 1), block):
        rows = slice(start, start + block)
        found.append(_march_block(lookup, occupied, step, rays_o[rows], rays_d[rows], jitter[rows], longest))
        n_found += len(found[-1][1])
        if n_found > capacity:
            break  # no ray of a later block would be served
    counts, t_mid, points, features, sigmas = (torch.cat(parts) for parts in zip(*found, strict=True))
    ends = torch.cumsum(counts, dim=0)
    n_served = int((ends <= capacity).sum())
    counts = counts[:n_served]
    n = int(ends[n_served - 1]) if n_served else 0
    samples = Samples(
        t_mid=t_mid[:n],
        deltas=torch.full_like(t_mid[:n], step),
        points=points[:n],
        features=features[:n],
        rays=torch.arange(n_served, device=rays_o.device),
        starts=ends[:n_served] - counts,
        counts=counts,
    )
    return samples, sigmas[:n]


def _march_block(
    lookup: Lookup,
    occupied: Tensor,
    step: float,
    rays_o: Tensor,
    rays_d: Tensor,
    jitter: Tensor,
    longest: int,
) -> tuple[Tensor, ...]:
    """(counts [n_rays], t, points, features, densities) of the visible samples of a block of rays."""
    t, u, candidate = fast(lattice, rays_o.device)(rays_o, rays_d, jitter, occupied, step, longest)
    places = candidate.reshape(-1).nonzero()[:, 0]
    points = u.reshape(-1, 3)[places]
    looked_up = [lookup(part) for part in points.split(LOOKUP_POINTS)]
    features, sigmas = (torch.cat(parts) for parts in zip(*looked_up, strict=True))
    depths = t.new_zeros(t.numel()).scatter(0, places, sigmas.to(t.dtype) * step).reshape(t.shape)
    visible = candidate & (sums_before(depths) <= OPAQUE_DEPTH)
    kept = visible.reshape(-1)[places]
    return visible.sum(dim=1), t.reshape(-1)[places][kept], points[kept], features[kept], sigmas[kept]
