"""The importance of stored values: by how much they change the colours of rays (`vfr_bake.baking.rate`)."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from exporters.head.onnx_head import Range
from player.asset.grid import SparseGrid
from player.asset.pyramid import Pyramid, places_between
from player.asset.sections import Grid
from vfr_bake.baking.distillation import TeacherRays, collect_training_rays
from vfr_bake.baking.grids import Layout
from vfr_bake.baking.head import FoldedHead
from vfr_bake.baking.refinement import Stored
from vfr_bake.kernels.stored_features import padded, slants
from vfr_bake.kernels.symbols import add_squares, add_to_coarser, from_coarser

RAYS_AT_ONCE = 1 << 12
"""Kept small: a ray through fog has hundreds of samples, and each takes 100 to 200 bytes while they are
processed."""
N_RAYS = 500_000
"""Most rays from which the importance is computed; more rays make it more exact."""
AROUND: dict[Grid, float] = {"densities": 5.0, "features": 1.0}
"""Importance added to each vertex, as a share of the mean importance around it, because rays that were not
drawn will meet it, too. It is larger for densities, whose effect depends more on the ray."""
EVERYWHERE: dict[Grid, float] = {"densities": 0.1, "features": 0.02}
"""Importance added to each vertex, as a share of the mean importance of all vertices."""


class Importance(NamedTuple):
    """The importance of stored values: the squares by which a unit of a value changes colours in [0, 1],
    averaged over rays and colour channels."""

    densities: np.ndarray
    """[n_densities] float32, for a unit of the density code."""
    features: np.ndarray
    """[n_features] float32, the sum over channels of the importance of a unit of each channel's code."""
    channels: np.ndarray
    """[n_channels] float64: the share of each channel in `features`; they add up to 1."""


def importance(
    stored: Stored,
    layout: Layout,
    grid: SparseGrid,
    teacher: TeacherRays,
    ranges: tuple[Range, ...] | None,
    background: np.ndarray,
) -> Importance:
    """Compute the importance of each stored value on up to N_RAYS of the teacher's rays, with feature lookups
    at every sample.

    The three colour channels of a ray are not differentiated one by one. Instead, their sum with random signs
    is: its derivatives have the same mean square.

    Args:
        stored: refined values and head.
        layout: the layout of the values.
        grid: the grid that the player makes of the finest level.
        teacher: rays.
        ranges: ranges of the head's activations, if it multiplies in 8 bits.
        background: [3] colour behind the scene.

    Raises TrainingError if no ray meets anything.
    """
    densities = grid.rows if layout.densities is layout.features else layout.densities.rows()
    rays = collect_training_rays(teacher.some(N_RAYS), grid, 0, densities)
    head, random = FoldedHead(stored.head, ranges=ranges), np.random.default_rng(0)
    of_densities, of_features = (np.zeros(len(v), np.float32) for v in (stored.density, stored.features))
    changed = np.zeros_like(of_densities), np.zeros_like(of_features)
    n_channels = stored.features.shape[1]
    of_channels = np.zeros(n_channels)
    behind = torch.from_numpy(background.astype(np.float32))
    for first in range(0, len(rays), RAYS_AT_ONCE):
        some = np.arange(first, min(first + RAYS_AT_ONCE, len(rays)))
        fetches = rays.fetches(some)
        values = fetches.interpolate(stored.features)
        composed = torch.from_numpy(fetches.composite(values, n_channels)).requires_grad_()
        opacity = torch.from_numpy(fetches.opacity).requires_grad_()
        shown = (head(composed, torch.from_numpy(rays.teacher.rays_d[some])) - behind) * opacity[:, None]
        signs = torch.from_numpy(random.choice(np.array([-1, 1], np.float32), (len(some), 3)))
        along, along_opacity = torch.autograd.grad((shown * signs).sum(), (composed, opacity))
        gradient = np.zeros((len(some), padded(n_channels)), np.float32)
        gradient[:, :n_channels] = along.numpy()
        squares = gradient[:, :n_channels].astype(np.float64) ** 2
        of_channels += squares.sum(axis=0)
        size = np.sqrt(squares.sum(axis=1)).astype(np.float32)
        slopes = np.repeat(size, np.diff(fetches.starts)) * fetches.weights
        add_squares(fetches.starts, *fetches.features, slopes, changed[1], of_features)
        slopes = np.empty(len(fetches.weights), np.float32)
        slants(
            fetches.starts, *fetches.densities, fetches.weights, fetches.opacity, values, gradient,
            along_opacity.numpy(), grid.density_low, grid.density_slope, fetches.lengths, stored.density,
            slopes,
        )  # fmt: skip
        add_squares(fetches.starts, *fetches.densities, slopes, changed[0], of_densities)
    n = np.float32(3 * len(rays))
    total = of_channels.sum()
    shares = of_channels / total if total > 0 else np.full(len(of_channels), 1 / len(of_channels))
    return Importance(of_densities / n, of_features / n, shares)


def expected_importance(grid: Grid, pyramid: Pyramid, importance: np.ndarray) -> np.ndarray:
    """Return the expected importance [n] float32 of the finest level's vertices for rays other than those
    from which `importance` was computed."""
    mean = importance.mean(dtype=np.float64)
    everywhere, share = np.float32(EVERYWHERE[grid] * mean), np.float32(AROUND[grid])
    if len(pyramid.levels) == 1:
        return importance + everywhere + share * np.float32(mean)
    fine, coarse = pyramid.vertices[:2]
    masks, places = fine.bricks.masks, places_between(fine, coarse)
    around, n = np.zeros((2, coarse.n), np.float32)
    add_to_coarser(masks, *places, importance, around)
    add_to_coarser(masks, *places, np.ones_like(importance), n)
    around /= n
    out = np.empty_like(importance)
    from_coarser(masks, *places, around, out)
    out *= share
    out += importance + everywhere
    return out


def importance_of_levels(grid: Grid, pyramid: Pyramid, importance: np.ndarray) -> list[np.ndarray]:
    """Return for each level of a whole pyramid the importance [n] float32 of its vertices, from the
    `importance` of the finest level. The importance of finer vertices is passed on to the coarser vertices
    that predict them."""
    found = [expected_importance(grid, pyramid, importance)]
    for fine, coarse in pairwise(pyramid.vertices):
        found.append(np.zeros(coarse.n, np.float32))
        add_to_coarser(fine.bricks.masks, *places_between(fine, coarse), found[-2], found[-1])
    return found
