"""Twins of the kernels in plain torch: the hash grid, compositing and the march, slow, readable and
differentiable by autograd.

The tests compare the kernels with them.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from player.march.march import OPAQUE_DEPTH
from vfr_bake.field.field import VfrField
from vfr_bake.field.hash_grid import HashGrid
from vfr_bake.kernels.hash_grid import N_CHANNELS, PRIME_Y, PRIME_Z


def encode(grid: HashGrid, points: Tensor) -> Tensor:
    """Return features [n_points, n_channels] at `points` [n_points, 3] of the unit cube, by levels."""
    outputs = []
    for level, n in enumerate(grid.layout.resolutions):
        position = points * n
        cell = position.floor().clamp(0, n - 1)
        inside = position - cell
        total = torch.zeros(len(points), N_CHANNELS, dtype=grid.table.dtype)
        for corner in range(8):
            bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
            weight = torch.where(bits.bool(), inside, 1 - inside).prod(dim=-1)
            total = total + weight[:, None] * grid.table[rows_of(grid, cell.long() + bits, level)]
        outputs.append(total)
    return torch.cat(outputs, dim=-1)


def rows_of(grid: HashGrid, vertices: Tensor, level: int) -> Tensor:
    """Return the rows [n] of the table that belong to `vertices` [n, 3] of a level."""
    x, y, z = vertices.unbind(-1)
    if grid.layout.hashed[level]:
        row = (x ^ (y * int(PRIME_Y)) ^ (z * int(PRIME_Z))) & grid.layout.mask
    else:
        side = grid.layout.resolutions[level] + 1
        row = (z * side + y) * side + x
    return row + int(grid.layout.offsets[level])


def composite(
    sigmas: Tensor, features: Tensor, deltas: Tensor, starts: Tensor, counts: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what `vfr_bake.rendering.compositing.composite` returns, computed ray by ray."""
    out, opacity, all_weights = [], [], []
    for start, count in zip(starts.tolist(), counts.tolist(), strict=True):
        depth = (sigmas * deltas)[start : start + count]
        # Optical depth in front of each sample. A difference of sums would cancel behind a dense sample.
        before = torch.cumsum(torch.cat([depth.new_zeros(1), depth]), dim=0)[:-1]
        weights = torch.exp(-before) * -torch.expm1(-depth)
        out.append((weights[:, None] * features[start : start + count]).sum(dim=0))
        opacity.append(-torch.expm1(-depth.sum()))
        all_weights.append(weights)
    return torch.stack(out), torch.stack(opacity), torch.cat(all_weights)


def march(
    field: VfrField, occupied: np.ndarray, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, step: float
) -> list[Tensor]:
    """Return the t of every ray's visible samples, found ray by ray and lattice point by lattice point:
    `vfr_bake.rendering.sampling.march` must find the same."""
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
            sigmas = field.density(encode(field.grid, u))
        before = torch.cumsum(torch.cat([sigmas.new_zeros(1), sigmas * step]), dim=0)[:-1]
        found.append(t[before <= OPAQUE_DEPTH])
    return found
