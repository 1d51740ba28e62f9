"""Multiresolution hash grid in torch: features at points, and the gradient added up in the table (Mueller et
al. 2022, section 3).

Letters as in `vfr_bake.kernels.hash_grid`; all levels of all points are processed at once.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vfr_bake.kernels.hash_grid import PRIME_Y, PRIME_Z, TableLevels
from vfr_bake.torch_kernels import fast

_PRIME_Y, _PRIME_Z = int(PRIME_Y), int(PRIME_Z)  # torch's compiler takes a numpy number for a tensor


def corners(points: Tensor, levels: TableLevels) -> tuple[Tensor, Tensor]:
    """Return (rows, trilinear weights), both [n_points, n_levels, 8] with x fastest, of the corners around
    `points` [n_points, 3] of the unit cube."""
    position = points[:, None, :] * levels.scales[:, None]
    n_cells = levels.scales.long()
    cell = torch.minimum(position.long().clamp(min=0), (n_cells - 1)[:, None])
    inside = position - cell
    weights = torch.stack([1 - inside, inside], dim=-1)  # [n_points, n_levels, 3, 2]
    vertices = cell[..., None] + torch.arange(2, device=points.device)
    x = vertices[:, :, 0, None, None, :]
    y = vertices[:, :, 1, None, :, None]
    z = vertices[:, :, 2, :, None, None]
    side, hashed = (n_cells + 1)[:, None, None, None], levels.hashed[:, None, None, None]
    # In 64 bits: the products do not overflow, and the mask keeps low bits, which 32-bit products have too.
    shared = (x ^ (y * _PRIME_Y) ^ (z * _PRIME_Z)) & levels.mask
    rows = torch.where(hashed, shared, (z * side + y) * side + x) + levels.offsets[:-1, None, None, None]
    wx, wy, wz = weights[:, :, 0], weights[:, :, 1], weights[:, :, 2]
    products = wx[:, :, None, None, :] * (wy[:, :, None, :, None] * wz[:, :, :, None, None])
    return rows.flatten(2), products.flatten(2)


def encode(points: Tensor, table: Tensor, levels: TableLevels) -> Tensor:
    """Return the features [n_points, n_levels * n_channels] at `points` [n_points, 3] of the unit cube, from
    `table` [n_entries, n_channels]."""
    rows, weights = corners(points, levels)
    return (weights[..., None] * table[rows]).sum(dim=2).flatten(1)


def scatter(points: Tensor, gradient: Tensor, n_entries: int, levels: TableLevels) -> Tensor:
    """Return the table's gradient [n_entries, n_channels], given that of `encode`
    [n_points, n_levels * n_channels].

    It is added up by `index_add`, which adds atomically on a GPU; autograd's own gradient would sort 33
    million rows in every step. The index is one-dimensional, because only that is fast on a CPU.
    """
    rows, weights = corners(points, levels)
    n_channels = gradient.shape[1] // rows.shape[1]
    values = weights[..., None] * gradient.reshape(rows.shape[0], rows.shape[1], 1, n_channels)
    entries = rows[..., None] * n_channels + torch.arange(n_channels, device=points.device)
    total = gradient.new_zeros(n_entries * n_channels)
    return total.index_add(0, entries.flatten(), values.flatten()).reshape(n_entries, n_channels)


def features_at(points: Tensor, table: Tensor, levels: TableLevels, features: Tensor | None = None) -> Tensor:
    """Encode as `encode` does, differentiably with respect to `table` alone. If the `features` are known
    already, they are returned as they are, with the same gradient."""
    return _Features.apply(points, table, levels, features)  # type: ignore[return-value]


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points: Tensor, table: Tensor, levels: TableLevels, features: Tensor | None) -> Tensor:
        ctx.save_for_backward(points)
        ctx.levels, ctx.n_entries = levels, len(table)
        if features is not None:
            return features
        return fast(encode, points.device)(points, table, levels)

    @staticmethod
    def backward(ctx, *grads: Tensor):
        (points,) = ctx.saved_tensors
        add_up = fast(scatter, points.device)
        return None, add_up(points, grads[0].contiguous(), ctx.n_entries, ctx.levels), None, None
