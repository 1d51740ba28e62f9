"""March of rays through the occupancy grid in torch: every lattice point of a block of rays at once.

Letters as in `vfr_bake.kernels.march`: samples of a ray lie at t_i = t_near + (i + jitter) * step, u = (x +
1) / 2. Empty space is not skipped: on a GPU, testing every cell costs less than threads that diverge.
"""

from __future__ import annotations

import torch
from torch import Tensor


def ray_box(rays_o: Tensor, rays_d: Tensor) -> tuple[Tensor, Tensor]:
    """Return entry and exit [n_rays] of rays [n_rays, 3] in [-1, 1]^3, entry at least 0; entry >= exit where
    a ray misses.

    >>> ray_box(torch.tensor([[-3.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
    (tensor([2.]), tensor([4.]))
    """
    crosses = rays_d != 0
    divisor = torch.where(crosses, rays_d, torch.ones_like(rays_d))
    a, b = (-1 - rays_o) / divisor, (1 - rays_o) / divisor
    outside = ~crosses & (rays_o.abs() > 1)  # parallel to a face, and outside of it
    low = torch.where(crosses, torch.minimum(a, b), torch.zeros_like(a))
    high = torch.where(crosses, torch.maximum(a, b), torch.full_like(a, 1e30))
    high = torch.where(outside, torch.full_like(a, -1), high)
    return low.amax(dim=1).clamp(min=0), high.amin(dim=1)


def lattice(
    rays_o: Tensor, rays_d: Tensor, jitter: Tensor, occupied: Tensor, step: float, n_points: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return t [n_rays, n_points], u [n_rays, n_points, 3], and a bool [n_rays, n_points] for the first
    `n_points` lattice points of rays [n_rays, 3]. The bool is true for points inside the box whose cell is
    `occupied` [n, n, n]."""
    t_near, t_far = ray_box(rays_o, rays_d)
    numbers = torch.arange(n_points, device=rays_o.device)
    t = t_near[:, None] + (numbers + jitter[:, None]) * step
    u = (rays_o[:, None] + t[..., None] * rays_d[:, None]) * 0.5 + 0.5
    n = occupied.shape[0]
    x, y, z = (u * n).long().clamp(0, n - 1).unbind(-1)
    inside = (t < t_far[:, None]) & (t_near < t_far)[:, None]
    return t, u, inside & occupied.reshape(-1)[(x * n + y) * n + z]
