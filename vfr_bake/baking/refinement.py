"""The head learns to live with what the bake did to its inputs.

Grid, projection, 8-bit codes and the choice of k samples change the composited features a little. The model
itself is the teacher: on rays of the training cameras the folded head is trained, from its exact weights on,
to give the full model's colours from the features that the player composes out of the baked arrays, by the
player's own march.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

from exporters.onnx_head import HeadWeights, Layer
from player.errors import TrainingError
from player.march_compiled import march
from player.sparse_grid import SparseGrid
from vfr_bake.field.spherical_harmonics import SphericalHarmonics
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.model_file import Model

N_RAYS = 1_000_000
"""Rays over all training views; about a third of them meet something."""
BATCH = 2048
FULL_CODE = 127.0
"""The largest feature code; in this unit the first weights are of the size that the learning rate fits."""
RATE = 5e-4
"""Adam's learning rate at first; it falls to zero along a cosine."""


@dataclass(frozen=True)
class Lessons:
    """What the player composes on n rays, and what the full model shows there."""

    codes: np.ndarray
    """[n, n_stored] composited feature codes, as the player gives them to the head."""
    dirs: np.ndarray
    """[n, 3] unit view directions."""
    opacity: np.ndarray
    """[n] of the baked grid."""
    colours: np.ndarray
    """[n, 3] the full model's colours times its opacity."""
    full_opacity: np.ndarray
    """[n] of the full model."""


def collect_lessons(model: Model, grid: SparseGrid, n_samples: int) -> Lessons:
    """Lessons from random pixels of all training views, where the baked grid holds something; in random
    order."""
    random = np.random.default_rng(0)
    cameras = model.model_cameras()
    parts: list[tuple[np.ndarray, ...]] = []
    for camera in cameras:
        n_pixels = camera.width * camera.height
        rays_o, rays_d = camera.rays()
        rows = random.choice(n_pixels, min(n_pixels, max(1, N_RAYS // len(cameras))), replace=False)
        rays_o, rays_d = rays_o[rows], rays_d[rows]
        played = march(grid, rays_o, rays_d, n_samples)
        hits = played.hits
        features, opacity, _ = model.occupancy.composited_features(model.field, rays_o[hits], rays_d[hits])
        colours = head_colours(model.field, features, rays_d[hits]) * opacity[:, None]
        parts.append((played.features, rays_d[hits], played.opacity[hits], colours, opacity))
    n_lessons = sum(len(part[0]) for part in parts)
    if n_lessons == 0:
        raise TrainingError("the baked grid shows nothing in any training view: train longer")
    order = random.permutation(n_lessons)
    return Lessons(*(np.concatenate(columns)[order] for columns in zip(*parts, strict=True)))


def refine(
    weights: HeadWeights, lessons: Lessons, n_steps: int, progress: Callable[[int, int], object]
) -> HeadWeights:
    """The head after `n_steps` of Adam on the squared error of the colours over random backgrounds."""
    torch.manual_seed(0)
    head = FoldedHead(weights)
    data = [torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in vars(lessons).values()]
    adam = torch.optim.Adam(head.parameters(), lr=RATE, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, max(n_steps, 1))
    for step in range(n_steps):
        rows = torch.randint(len(data[0]), (BATCH,))
        codes, dirs, opacity, colours, full_opacity = (column[rows] for column in data)
        background = torch.rand(BATCH, 3)
        shown = head(codes, dirs) * opacity[:, None] + background * (1 - opacity)[:, None]
        wanted = colours + background * (1 - full_opacity)[:, None]
        adam.zero_grad(set_to_none=True)
        ((shown - wanted) ** 2).mean().backward()
        adam.step()
        schedule.step()
        if step % 50 == 49 or step == n_steps - 1:
            progress(step + 1, n_steps)
    return head.weights()


class FoldedHead(nn.Module):
    """The exported graph of `exporters.onnx_head`, in torch."""

    def __init__(self, weights: HeadWeights) -> None:
        super().__init__()
        self._like = weights
        self.harmonics = SphericalHarmonics(weights.sh_degree)
        layers = [*weights.spatial, weights.to_sh, *weights.directional, weights.output]
        d_bottleneck, d_sh, bias = weights.directional_first
        arrays = [array for layer in layers for array in layer] + [d_bottleneck, d_sh, bias]
        self.arrays = nn.ParameterList([torch.tensor(a, dtype=torch.float32) for a in arrays])
        self.arrays[0].data *= FULL_CODE

    def forward(self, codes: Tensor, dirs: Tensor) -> Tensor:
        """Colours [n, 3] from composited codes [n, n_stored] and unit dirs [n, 3]."""
        layers, (d_bottleneck, d_sh, bias) = self._layers()
        n_spatial = len(self._like.spatial)
        h = codes / FULL_CODE
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
        arrays[0] = (arrays[0][0] / FULL_CODE, arrays[0][1])
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
