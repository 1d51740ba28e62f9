"""Multiresolution hash grid, F(x) of the paper: interpolated features at points of the unit cube.

Letters: level l has N_l cells per axis, N_l = floor(base * growth^l). Its (N_l + 1)^3 vertices have an entry
each, or share 2^log2_table_size entries through the hash (x xor y * 2654435761 xor z * 805459861) mod size
(Mueller et al. 2022, eq. 4).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor, nn

from vfr_bake.config import FieldConfig
from vfr_bake.kernels import hash_grid as kernels
from vfr_bake.kernels.hash_grid import HashGridArrays, TableLevels
from vfr_bake.torch_kernels.hash_grid import features_at

Backend = Literal["numba", "torch"]
"""The kernels to run: numba's, on a CPU, or torch's, on any device."""


def zeros(*shape: int) -> Tensor:
    """Return a float32 tensor of zeros whose memory NumPy has allocated.

    For large arrays NumPy asks Linux for pages of 2 MB, which torch does not. A hash grid is read and written
    at random, and with pages of 4 kB nearly every access would first need a lookup of its page.

    >>> zeros(2, 3).shape
    torch.Size([2, 3])
    """
    return torch.from_numpy(np.zeros(shape, np.float32))


def level_resolutions(n_levels: int, base_resolution: int, max_resolution: int) -> list[int]:
    """Return the cells per axis of every level, in geometric progression from base to max.

    >>> level_resolutions(3, 16, 64)
    [16, 32, 64]
    """
    if n_levels == 1:
        return [max_resolution]
    growth = (max_resolution / base_resolution) ** (1 / (n_levels - 1))
    return [int(np.floor(base_resolution * growth**level + 1e-6)) for level in range(n_levels)]


class GridLayout:
    """Layout of a table: which entries belong to which level, and which levels share
    entries through the hash.

    >>> GridLayout(n_levels=2, base_resolution=4, max_resolution=64, log2_table_size=10).n_entries
    1149
    """

    def __init__(
        self, n_levels: int, base_resolution: int, max_resolution: int, log2_table_size: int
    ) -> None:
        self.resolutions = level_resolutions(n_levels, base_resolution, max_resolution)
        size = 2**log2_table_size
        vertices = [(n + 1) ** 3 for n in self.resolutions]
        self.hashed = np.array([n > size for n in vertices])
        self.offsets = np.concatenate([[0], np.cumsum([min(n, size) for n in vertices])]).astype(np.int64)
        self.mask = size - 1
        self._levels: dict[tuple[torch.device, torch.dtype], TableLevels] = {}

    @property
    def n_entries(self) -> int:
        return int(self.offsets[-1])

    def arrays(self, dtype: np.dtype | type) -> TableLevels:
        """Return the levels as numba's kernels take them, for a table of type `dtype`."""
        return TableLevels(np.array(self.resolutions, dtype), self.offsets, self.hashed, self.mask)

    def grid(self, table: Tensor) -> HashGridArrays:
        """Return the table, which is on a CPU, with its levels, as numba's kernels take them."""
        array = table.detach().numpy()
        return HashGridArrays(array, *self.arrays(array.dtype))

    def levels(self, table: Tensor) -> TableLevels:
        """Return the levels as torch's kernels take them, on the device and in the type of `table`; they are
        made once for each device and type."""
        place = (table.device, table.dtype)
        if place not in self._levels:
            self._levels[place] = TableLevels(
                scales=torch.tensor(self.resolutions, dtype=table.dtype, device=table.device),
                offsets=torch.from_numpy(self.offsets).to(table.device),
                hashed=torch.from_numpy(self.hashed).to(table.device),
                mask=self.mask,
            )
        return self._levels[place]


class HashGrid(nn.Module):
    """Features of `n_levels` grids, two channels each.

    >>> grid = HashGrid(FieldConfig(n_levels=2, base_resolution=4, max_resolution=8, log2_table_size=10))
    >>> grid(torch.rand(5, 3)).shape
    torch.Size([5, 4])
    """

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        self.layout = GridLayout(
            config.n_levels, config.base_resolution, config.max_resolution, config.log2_table_size
        )
        self.pending: list[tuple[Tensor, Tensor]] | None = None
        """If a list, backward passes append (points, gradient of the features) to it instead
        of scattering gradients."""
        self.backend: Backend = "numba"
        """The kernels that `forward` runs on a CPU; on other devices torch's always run."""
        # Small and symmetric, as in instant-ngp: the first features say nothing about the scene.
        self.table = nn.Parameter(zeros(self.layout.n_entries, kernels.N_CHANNELS).uniform_(-1e-4, 1e-4))

    def forward(self, points: Tensor, features: Tensor | None = None) -> Tensor:
        """Return the features [n_points, n_channels] at `points` [n_points, 3] of the unit cube.

        If the march has already computed `features`, they are returned, and only their gradient is computed
        here. Not differentiable with respect to `points`.
        """
        if self.backend == "torch" or points.device.type != "cpu":
            return features_at(points, self.table, self.layout.levels(self.table), features)
        return _Encode.apply(points, self.table, self, features)  # type: ignore[return-value]


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points: Tensor, table: Tensor, grid: HashGrid, features: Tensor | None) -> Tensor:
        ctx.grid = grid
        ctx.save_for_backward(points, table)
        if features is not None:
            return features
        n_channels = kernels.N_CHANNELS * len(grid.layout.resolutions)
        out = torch.empty(len(points), n_channels, dtype=table.dtype)
        kernels.encode(points.detach().numpy(), grid.layout.grid(table), out.numpy())
        return out

    @staticmethod
    def backward(ctx, *grads: Tensor):
        points, table = ctx.saved_tensors
        gradient = grads[0].contiguous()
        if ctx.grid.pending is not None:
            ctx.grid.pending.append((points, gradient))
            return None, None, None, None
        # A table with a gradient buffer receives the gradient in place, which saves clearing and adding 40 MB
        # per step.
        in_place = table.grad is not None
        grad_table = table.grad if in_place else torch.zeros_like(table)
        levels = ctx.grid.layout.arrays(gradient.numpy().dtype)
        kernels.scatter(points.numpy(), gradient.numpy(), levels, get_num_threads(), grad_table.numpy())
        return None, None if in_place else grad_table, None, None
