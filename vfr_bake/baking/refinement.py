"""Head and stored features learn to live with what the bake did.

Grid, projection, 8-bit codes and the choice of k samples change the composited features a little. The model
itself is the teacher: the folded head is trained, from its exact weights on, to give the full model's colours
from the features that the player composes out of the baked arrays, and the stored features with it. Codes are
rounded where they are composed, and move as if they were not (straight through).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor

from exporters.head.onnx_head import HeadWeights, Range
from player.asset.grid import SparseGrid
from player.march.march import MAX_TAU
from vfr_bake.baking.folded_head import FoldedHead
from vfr_bake.baking.lessons import Lessons, compose_into
from vfr_bake.kernels.stored_features import descend, descend_density, slants, weigh

BATCH, HEAD_BATCH = 2048, 1024
"""Rays of a step, and of one in which the head learns alone: twice the steps on as many rays gain more."""
UNIT = 4.0
"""Mean sizes of a channel's composites that make a unit of it; so large a unit makes the first weights of the
size that the learning rate fits."""
HEAD_RATE = 5e-4
"""Adam's learning rate for a head that the full model had; it falls to zero along a cosine."""
CODE_RATE = 0.25
"""Adagrad's learning rate of codes up to 127; it falls to zero along the same cosine."""

DENSITY_RATE = 1.0
"""The same of the density's codes."""
DAMPING = 8.0
"""Times the mean that the first batch leaves at the vertices that it meets: where Adagrad's squares of all
begin. A vertex that few rays meet would else move as far as the others, to suit those rays alone."""
N_WARM, N_TIMED = 10, 40
"""Steps of a round that are not timed, because something may be compiled for the first time, and steps that
are."""

Progress = Callable[[int, int], object]


@dataclass(frozen=True, eq=False)
class Stored:
    """What the asset will hold, codes as floats that need not be whole."""

    head: HeadWeights
    features: np.ndarray
    """[n_features, n_channels] float32 within -127..127."""
    density: np.ndarray
    """[n_densities] float32 within 0..255."""


class Steps:
    """The steps of a round of refinement: as many as are asked for, or fewer where there is no time for them,
    which the first ones tell.

    >>> steps = Steps(40, lambda done, of: None)
    >>> [round(steps.falling(step), 3) for step in steps][::10]
    [1.0, 0.854, 0.5, 0.146]
    """

    def __init__(self, n_steps: int, progress: Progress, seconds: float = float("inf")) -> None:
        """`seconds`: what they may take."""
        self.n = n_steps
        self._progress, self._seconds = progress, seconds

    def __iter__(self) -> Iterator[int]:
        step, begin = 0, 0.0
        while step < self.n:
            yield step
            step += 1
            if step == N_WARM:
                begin = time.monotonic()
            elif step == N_WARM + N_TIMED:
                # A clock may stand still for as long as 16 ms.
                pace = max(time.monotonic() - begin, 1e-9) / N_TIMED
                self.n = max(int(min(self.n, self._seconds / pace)), step)
            if step % 50 == 0 or step == self.n:
                self._progress(step, self.n)

    def falling(self, step: int) -> float:
        """Share of a learning rate, along a cosine from 1 to 0."""
        return float(0.5 * (1 + np.cos(np.pi * step / self.n)))


def learn_head(stored: Stored, lessons: Lessons, steps: Steps, rate: float) -> HeadWeights:
    """The head after `steps` on the squared error of the colours over random backgrounds, with everything
    else as it is stored: what the rays compose is found once."""
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    head = FoldedHead(stored.head, UNIT * lessons.typical(stored.features))
    adam = torch.optim.Adam(head.parameters(), lr=rate, fused=True)
    composed = lessons.composed(stored.features)
    for step in steps:
        adam.param_groups[0]["lr"] = rate * steps.falling(step)
        some = random.integers(0, len(lessons), HEAD_BATCH)
        shown, opacity = torch.from_numpy(composed[some]), torch.from_numpy(lessons.opacity[some])
        adam.zero_grad(set_to_none=True)
        _loss(head, shown, opacity, lessons, some).backward()
        adam.step()
    return head.weights()


def refine(
    stored: Stored,
    lessons: Lessons,
    steps: Steps,
    head_rate: float = HEAD_RATE,
    code_rate: float = CODE_RATE,
    grid: SparseGrid | None = None,
    ranges: tuple[Range, ...] | None = None,
) -> Stored:
    """Head and codes after `steps` of the same kind.

    Codes are rounded wherever they are composed, and returned as they stand, not rounded. The features of
    `stored` are moved themselves: there may be no room for them twice. With a `grid`, whose lookups and
    densities `lessons` must hold at every sample, the densities learn too, and the weights of the lessons
    follow them. With `ranges` the head learns to live with 8 bits (`vfr_bake.baking.folded_head`).
    """
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    head = FoldedHead(stored.head, UNIT * lessons.typical(stored.features), ranges)
    features, density = stored.features, stored.density.copy()
    steep, steep_density = np.zeros(len(features), np.float32), np.zeros(len(density), np.float32)
    n_parts = get_num_threads()
    adam = torch.optim.Adam(head.parameters(), lr=head_rate, fused=True)
    for step in steps:
        falling = steps.falling(step)
        moving = falling if step else 0.0  # what is stored waits for the squares of the first rays
        adam.param_groups[0]["lr"] = head_rate * falling
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
        composed = torch.from_numpy(codes).requires_grad_()
        opacity = torch.from_numpy(of_grid).requires_grad_(grid is not None)
        adam.zero_grad(set_to_none=True)
        _loss(head, composed, opacity, lessons, some).backward()
        adam.step()
        assert composed.grad is not None
        of_composed = composed.grad.numpy()
        where = (fetches.starts, fetches.rows, fetches.shares)
        if grid is not None:
            assert opacity.grad is not None
            of_fetches = np.empty(len(fetches.weights), np.float32)
            slants(
                *where, *of_densities, fetches.weights, of_grid, features, of_composed,
                opacity.grad.numpy(), grid.density_low, grid.density_slope, fetches.lengths, density,
                of_fetches,
            )  # fmt: skip
            rate = np.float32(DENSITY_RATE * moving)
            descend_density(*of_densities, of_fetches, rate, n_parts, density, steep_density)
        rate = np.float32(code_rate * moving)
        descend(*where, fetches.weights, of_composed, rate, n_parts, features, steep)
        if step == 0:
            _damp(steep)
            _damp(steep_density)
    return Stored(head.weights(), features, density)


def _damp(steepness: np.ndarray) -> None:
    """Let the squares [n] of all vertices begin at DAMPING times those that the first rays have left."""
    met = steepness[steepness > 0]
    steepness[:] = DAMPING * met.mean() if len(met) else 0


def _loss(head: FoldedHead, composed: Tensor, opacity: Tensor, lessons: Lessons, some: np.ndarray) -> Tensor:
    """Mean squared error of the colours of the lessons `some` over random backgrounds."""
    dirs, colours, full_opacity = (
        torch.from_numpy(column[some]) for column in (lessons.dirs, lessons.colours, lessons.full_opacity)
    )
    background = torch.rand(len(some), 3)
    shown = head(composed, dirs) * opacity[:, None] + background * (1 - opacity)[:, None]
    wanted = colours + background * (1 - full_opacity)[:, None]
    return ((shown - wanted) ** 2).mean()
