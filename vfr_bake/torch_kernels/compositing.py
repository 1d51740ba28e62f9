"""Compositing and distortion on packed samples in torch; letters as in `vfr_bake.kernels.compositing`.

Sums along rays are computed in a table with one row for each ray, padded with samples of length 0. A running
sum over the samples of all rays, minus its value before the ray, would lose thin samples behind dense ones.
Only values with one channel are padded. Autograd computes the gradients; all of its operations gather,
scatter or add by index, and none of them sorts.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad


def owners(starts: Tensor, counts: Tensor, n_samples: int) -> Tensor:
    """Return the number [n_samples] of the ray that each sample belongs to. Ray r has the rows
    `starts[r] : starts[r] + counts[r]`, and every row must belong to some ray.

    >>> owners(torch.tensor([3, 0]), torch.tensor([2, 3]), 5).tolist()
    [1, 1, 1, 0, 0]
    """
    # A ray without samples begins where its neighbour does: a stable sort keeps the two in their order.
    order = torch.argsort(starts, stable=True)
    return order.repeat_interleave(counts[order], output_size=n_samples)


def sums_before(values: Tensor) -> Tensor:
    """Return the sum of the values before each of `values` [..., n] along the last axis.

    >>> sums_before(torch.tensor([1.0, 2.0, 4.0])).tolist()
    [0.0, 1.0, 3.0]
    """
    return pad(torch.cumsum(values, dim=-1), (1, 0))[..., :-1]


class Padding:
    """Conversion of packed samples [n_samples] to padded rows [n_rays, longest], and back."""

    def __init__(self, starts: Tensor, counts: Tensor, n_samples: int) -> None:
        self.rays = owners(starts, counts, n_samples)
        longest = int(counts.max()) if len(counts) else 0
        self._shape = (len(counts), longest)
        inside = torch.arange(n_samples, device=starts.device) - starts[self.rays]
        self._places = self.rays * longest + inside

    def rows(self, packed: Tensor) -> Tensor:
        """Return [n_rays, longest]: the `packed` values of each ray, then 0 where it has no more samples."""
        flat = packed.new_zeros(self._shape[0] * self._shape[1])
        return flat.scatter(0, self._places, packed).reshape(self._shape)

    def packed(self, rows: Tensor) -> Tensor:
        """Return [n_samples]: the packed values of padded `rows`."""
        return rows.reshape(-1).gather(0, self._places)


class Composite(NamedTuple):
    """Composites of the samples along rays."""

    values: Tensor
    """[n_rays, n_channels]: sum of the samples' features, or of their colours, times their weights."""
    opacity: Tensor
    """[n_rays]."""
    weights: Tensor
    """[n_samples]."""


def composite(sigmas: Tensor, features: Tensor, deltas: Tensor, starts: Tensor, counts: Tensor) -> Composite:
    """Composite packed samples, differentiably, as `vfr_bake.rendering.compositing.composite` does."""
    padding = Padding(starts, counts, len(sigmas))
    depths = padding.rows(sigmas * deltas)
    weights = padding.packed(torch.exp(-sums_before(depths)) * -torch.expm1(-depths))
    out = features.new_zeros(len(starts), features.shape[1])
    out = out.index_add(0, padding.rays, weights[:, None] * features)
    return Composite(out, -torch.expm1(-depths.sum(dim=1)), weights)


def distortion(
    weights: Tensor, mids: Tensor, widths: Tensor, reach: float, starts: Tensor, counts: Tensor
) -> Tensor:
    """Return the distortion [n_rays] of the weights over intervals with ascending `mids` and with `widths`
    [n_samples], as `vfr_bake.rendering.compositing.distortion` does."""
    padding = Padding(starts, counts, len(weights))
    w, m, b = (padding.rows(values) for values in (weights, mids, widths))
    before, before_m = sums_before(w), sums_before(w * m)
    # The first interval within reach. Padding behind a ray's last interval must ascend, too; its weight is 0.
    ascending = m.cummax(dim=1).values if m.numel() else m
    low = torch.searchsorted(ascending, m - reach, right=True)
    far, far_m = before.gather(1, low), before_m.gather(1, low)
    # Every pair is counted once, from its later interval, but is in the sum over i and j twice.
    pairs = 2 * w * (m * (before - far) - (before_m - far_m) + reach * far)
    return (pairs + w * w * b / 3).sum(dim=1)
