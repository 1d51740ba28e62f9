"""Head and stored features learn to live with what the bake did.

Grid, projection, 8-bit codes and the choice of k samples change the composited features a little. The model
itself is the teacher: the folded head is trained, from its exact weights on, to give the full model's colours
from the features that the player composes out of the baked arrays, and the stored features with it. Codes are
rounded where they are composed, and move as if they were not (straight through).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor, nn
from torch.nn.functional import gelu

from exporters.onnx_head import HeadWeights, Layer
from player.march import MAX_TAU
from player.sparse_grid import SparseGrid
from vfr_bake.baking.lessons import Lessons, compose_into
from vfr_bake.field.spherical_harmonics import SphericalHarmonics
from vfr_bake.kernels.stored_features import descend, descend_density, slants, weigh

BATCH = 2048
UNIT = 4.0
"""Mean sizes of a channel's composites that make a unit of it; so large a unit makes the first weights of the
size that the learning rate fits."""
HEAD_RATE = 5e-4
"""Adam's learning rate for a head that the full model had; it falls to zero along a cosine."""
CODE_RATE = 0.25
"""Adagrad's learning rate of codes up to 127; it falls to zero along the same cosine."""

DENSITY_RATE = 1.0
"""The same of the density's codes."""

Progress = Callable[[int, int], object]


@dataclass(frozen=True, eq=False)
class Stored:
    """What the asset will hold, codes as floats that need not be whole."""

    head: HeadWeights
    features: np.ndarray
    """[n_features, n_channels] float32 within -127..127."""
    density: np.ndarray
    """[n_densities] float32 within 0..255."""


def refine(
    stored: Stored,
    lessons: Lessons,
    n_steps: int,
    progress: Progress,
    head_rate: float = HEAD_RATE,
    code_rate: float = CODE_RATE,
    grid: SparseGrid | None = None,
) -> Stored:
    """Head and codes after `n_steps` on the squared error of the colours over random backgrounds.

    Codes are rounded wherever they are composed, and returned as they stand, not rounded; `stored` is left
    alone. With `code_rate` 0 only the head learns. With a `grid`, whose lookups and densities `lessons` must
    hold at every sample, the densities learn too, and the weights of the lessons follow them.
    """
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    typical = lessons.typical(stored.features)
    head = FoldedHead(stored.head, UNIT * typical)
    features, density = stored.features.copy(), stored.density.copy()
    steep, steep_density = np.zeros(len(features), np.float32), np.zeros(len(density), np.float32)
    n_parts = get_num_threads()
    adam = torch.optim.Adam(head.parameters(), lr=head_rate, fused=True)
    for step in range(n_steps):
        falling = np.float32(0.5 * (1 + np.cos(np.pi * step / n_steps)))
        adam.param_groups[0]["lr"] = float(head_rate * falling)
        some = random.integers(0, len(lessons), BATCH)
        fetches, of_grid = lessons.fetches(some), lessons.opacity[some]
        of_densities = (fetches.density_rows, fetches.density_shares)
        if grid is not None:
            weigh(
                fetches.starts, *of_densities, density, grid.density_low, grid.density_slope,
                fetches.lengths, MAX_TAU, fetches.weights, of_grid,
            )  # fmt: skip
        codes = np.empty((BATCH, features.shape[1]), np.float32)
        compose_into(fetches, features, codes)
        composed = torch.from_numpy(codes).requires_grad_(code_rate > 0)
        opacity = torch.from_numpy(of_grid).requires_grad_(grid is not None)
        adam.zero_grad(set_to_none=True)
        _loss(head, composed, opacity, lessons, some).backward()
        adam.step()
        where = (fetches.starts, fetches.rows, fetches.shares)
        if grid is not None:
            assert composed.grad is not None and opacity.grad is not None
            of_fetches = np.empty(len(fetches.weights), np.float32)
            slants(
                *where, *of_densities, fetches.weights, of_grid, features, composed.grad.numpy(),
                opacity.grad.numpy(), grid.density_low, grid.density_slope, fetches.lengths, density,
                of_fetches,
            )  # fmt: skip
            rate = np.float32(DENSITY_RATE) * falling
            descend_density(*of_densities, of_fetches, rate, n_parts, density, steep_density)
        if composed.grad is not None:
            rate = np.float32(code_rate) * falling
            descend(*where, fetches.weights, composed.grad.numpy(), rate, n_parts, features, steep)
        if step % 50 == 49 or step == n_steps - 1:
            progress(step + 1, n_steps)
    return Stored(head.weights(), features, density)


def _loss(head: FoldedHead, composed: Tensor, opacity: Tensor, lessons: Lessons, some: np.ndarray) -> Tensor:
    """Mean squared error of the colours of the lessons `some` over random backgrounds."""
    dirs, colours, full_opacity = (
        torch.from_numpy(column[some]) for column in (lessons.dirs, lessons.colours, lessons.full_opacity)
    )
    background = torch.rand(len(some), 3)
    shown = head(composed, dirs) * opacity[:, None] + background * (1 - opacity)[:, None]
    wanted = colours + background * (1 - full_opacity)[:, None]
    return ((shown - wanted) ** 2).mean()


class FoldedHead(nn.Module):
    """The exported graph of `exporters.onnx_head`, in torch; composites are counted in `units` [n_channels],
    so that channels of small codes are learned as fast as those of large ones."""

    def __init__(self, weights: HeadWeights, units: np.ndarray | None = None) -> None:
        super().__init__()
        self._like = weights
        self._units = np.ones(weights.n_channels) if units is None else units.astype(np.float64)
        self.harmonics = SphericalHarmonics(weights.sh_degree)
        layers = [*weights.spatial, weights.to_sh, *weights.directional, weights.output]
        d_bottleneck, d_sh, bias = weights.directional_first
        arrays = [array for layer in layers for array in layer] + [d_bottleneck, d_sh, bias]
        arrays[0] = arrays[0] * self._units[:, None]
        self.arrays = nn.ParameterList([torch.tensor(a, dtype=torch.float32) for a in arrays])
        self._per_unit = torch.tensor(1 / self._units, dtype=torch.float32)

    def forward(self, codes: Tensor, dirs: Tensor) -> Tensor:
        """Colours [n, 3] from composited codes [n, n_stored] and unit dirs [n, 3]."""
        layers, (d_bottleneck, d_sh, bias) = self._layers()
        n_spatial = len(self._like.spatial)
        h = codes * self._per_unit
        for weight, b in layers[:n_spatial]:
            h = gelu(torch.addmm(b, h, weight))
        weight, b = layers[n_spatial]
        basis = self.harmonics(dirs).repeat_interleave(self._like.n_sh_features, dim=-1)
        encoded = torch.addmm(b, h, weight) * basis
        h = gelu(torch.addmm(bias, h, d_bottleneck) + encoded @ d_sh)
        for weight, b in layers[n_spatial + 1 : -1]:
            h = gelu(torch.addmm(b, h, weight))
        weight, b = layers[-1]
        return torch.sigmoid(torch.addmm(b, h, weight))

    def _layers(self) -> tuple[list[tuple[Tensor, Tensor]], tuple[Tensor, Tensor, Tensor]]:
        a = list(self.arrays)
        return list(zip(a[:-3:2], a[1:-3:2], strict=True)), (a[-3], a[-2], a[-1])

    def weights(self) -> HeadWeights:
        """Back to numpy, in the form that was given."""
        layers, first = self._layers()

        def plain(tensors: tuple[Tensor, ...]) -> tuple[np.ndarray, ...]:
            return tuple(t.detach().double().numpy() for t in tensors)

        arrays: list[Layer] = [plain(layer) for layer in layers]  # type: ignore[misc]
        arrays[0] = (arrays[0][0] / self._units[:, None], arrays[0][1])
        n_spatial = len(self._like.spatial)
        return HeadWeights(
            spatial=tuple(arrays[:n_spatial]),
            to_sh=arrays[n_spatial],
            directional_first=plain(first),  # type: ignore[arg-type]
            directional=tuple(arrays[n_spatial + 1 : -1]),
            output=arrays[-1],
            sh_degree=self._like.sh_degree,
            n_sh_features=self._like.n_sh_features,
        )


def runner(weights: HeadWeights) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The head as a function of composited features [n, n_channels] and unit dirs [n, 3]."""
    head = FoldedHead(weights)

    @torch.no_grad()
    def colours(features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        parts = [
            head(torch.from_numpy(features[i : i + 8192]), torch.from_numpy(dirs[i : i + 8192])).numpy()
            for i in range(0, len(features), 8192)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)

    return colours
