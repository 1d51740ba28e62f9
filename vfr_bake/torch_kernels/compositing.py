"""Compositing and distortion on packed samples in torch; letters as in `vfr_bake.kernels.compositing`.

Sums along a ray are made in a table with one row a ray, padded with samples of no length: a sum over all
samples, less what came before the ray, would lose thin samples behind dense ones. Only numbers of one channel
are padded. Autograd finds the gradients; every step of it gathers, scatters or adds by index, none sorts.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad


def owners(starts: Tensor, counts: Tensor, n_samples: int) -> Tensor:
    """Number [n_samples] of the ray that each sample belongs to; ray r has the rows `starts[r] : starts[r] +
    counts[r]`, and all rows belong to some ray.

    >>> owners(torch.tensor([3, 0]), torch.tensor([2, 3]), 5).tolist()
    [1, 1, 1, 0, 0]
    """
    # Stable, as rays without samples begin where their neighbour does.
    order = torch.argsort(starts, stable=True)
    return order.repeat_interleave(counts[order], output_size=n_samples)


def sums_before(values: Tensor) -> Tensor:
    """Sum of what comes before each of `values` [..., n] along the last axis.

    >>> sums_before(torch.tensor([1.0, 2.0, 4.0])).tolist()
    [0.0, 1.0, 3.0]
    """
    return pad(torch.cumsum(values, dim=-1), (1, 0))[..., :-1]


class Padding:
    """Packed samples [n_samples] as rows [n_rays, longest], and back."""

    def __init__(self, starts: Tensor, counts: Tensor, n_samples: int) -> None:
        self.rays = owners(starts, counts, n_samples)
        longest = int(counts.max()) if len(counts) else 0
        self._shape = (len(counts), longest)
        inside = torch.arange(n_samples, device=starts.device) - starts[self.rays]
        self._places = self.rays * longest + inside

    def rows(self, packed: Tensor) -> Tensor:
        """[n_rays, longest], 0 where a ray has no more samples."""
        flat = packed.new_zeros(self._shape[0] * self._shape[1])
        return flat.scatter(0, self._places, packed).reshape(self._shape)

    def packed(self, rows: Tensor) -> Tensor:
        """[n_samples] of what `rows` made."""
        return rows.reshape(-1).gather(0, self._places)


class Composite(NamedTuple):
    """What samples along rays come to."""

    values: Tensor
    """[n_rays, n_channels] sum of the samples' features, or of their colours, by their weights."""
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
    """Distortion [n_rays] of the weights over intervals with ascending `mids` and `widths` [n_samples], as
    `vfr_bake.rendering.compositing.distortion`."""
    padding = Padding(starts, counts, len(weights))
    w, m, b = (padding.rows(values) for values in (weights, mids, widths))
    before, before_m = sums_before(w), sums_before(w * m)
    # The first interval within reach; what is behind a ray's last one weighs nothing, and must ascend.
    ascending = m.cummax(dim=1).values if m.numel() else m
    low = torch.searchsorted(ascending, m - reach, right=True)
    far, far_m = before.gather(1, low), before_m.gather(1, low)
    # Every pair is met from its later interval: the sum over all is twice that.
    pairs = 2 * w * (m * (before - far) - (before_m - far_m) + reach * far)
    return (pairs + w * w * b / 3).sum(dim=1)
