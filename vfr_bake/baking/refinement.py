"""Head, stored features and densities tuned to the model, and what they are tuned for: how many lookups a
ray, and a head in 8 bits or not.

Head and stored features learn to live with what the bake did.

Grid, projection, 8-bit codes and the choice of k samples change the composited features a little. The model
itself is the teacher: the folded head is trained, from its exact weights on, to give the full model's colours
from the features that the player composes out of the baked arrays, and the stored features with it. Codes are
rounded where they are composed, and move as if they were not (straight through).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor

from exporters.head.onnx_head import HeadWeights, Range
from exporters.head.ranges import activation_ranges
from player.asset.grid import SparseGrid
from player.march.march import MAX_TAU
from vfr_bake.baking.distillation import Lessons, Taught, collect_lessons, compose_into
from vfr_bake.baking.grids import Layout, encode_features
from vfr_bake.baking.head import FoldedHead, runner, small_head
from vfr_bake.baking.held_out import HeldOut, Stage
from vfr_bake.baking.limits import LOOKUPS
from vfr_bake.config import BakeConfig
from vfr_bake.kernels.stored_features import descend, descend_density, slants, weigh
from vfr_bake.presets import BakeChoice
from vfr_bake.training.model_file import Model

N_CALIBRATION = 20_000
"""Rays that decide the ranges of the head's activations."""
NEW_HEAD_RATE = 8e-3
"""Adam's learning rate of a head that has not learned yet."""
NEW_HEAD_STEPS = 4
"""Its steps for each of another round: they take a quarter of the time."""
AT_K = {False: 0.1, True: 0.5}
"""Of the rate of the round before, by whether the head is a new one: the model's own has less to learn."""
DIRECTION_SHARE = 0.1
"""Of the loss that a preset aims at: a small head leaves the direction out where that loses no more."""
ROUNDING_LEFT = 0.5
"""Of what a head loses by 8 bits, after it was tuned with them (docs/baking.md)."""


class Tuning:
    """What the rounds of refinement share, and what they find out."""

    def __init__(
        self,
        model: Model,
        config: BakeConfig,
        choice: BakeChoice,
        held_out: HeldOut,
        progress: Callable[[str], Progress],
        seconds: float,
    ) -> None:
        """`seconds`: what all rounds may take, if the number of their steps was not asked for."""
        self.n_fetches = choice.n_fetches
        """Lookups a ray, 0 for all."""
        self.ranges: tuple[Range, ...] | None = None
        """Of the head's activations, if it multiplies in 8 bits."""
        self.lookups: dict[str, float] = {}
        """Expected loss in dB by the lookups that were tried."""
        self.left_out: dict[str, str] = {}
        """What the scene does not need, and what that changed."""
        self._model, self._config, self._choice = model, config, choice
        self._held_out, self._progress = held_out, progress
        self._until = time.monotonic() + (seconds if config.refine_steps is None else float("inf"))
        self._rounds_left = 3 if choice.head_width else 2

    def run(self, stored: Stored, layout: Layout, taught: Taught) -> Stored:
        """Head and stored values adapted to each other: at every sample, then at the k that are played. Moves
        the features of `stored` themselves."""
        choice = self._choice
        grid = layout.grid(stored.density, stored.features)
        if choice.refine_steps == 0:
            self._choose_lookups_and_bits(stored, grid, taught)
            return stored
        head_rate, code_rate = HEAD_RATE, CODE_RATE * choice.code_levels / 127
        before = self._held_out.stages[-1]
        same = layout.densities is layout.features
        lessons = collect_lessons(taught, grid, 0, grid.rows if same else layout.densities.rows())
        if choice.head_width:
            new = self._new_head(stored.head, lessons.typical(stored.features))
            stored = replace(stored, head=new)
            with self._steps("small head", NEW_HEAD_STEPS * choice.refine_steps) as steps:
                stored = replace(stored, head=learn_head(stored, lessons, steps, NEW_HEAD_RATE))
            before = self._held_out.measure("small head", grid, runner(stored.head), 0)
            head_rate = NEW_HEAD_RATE / 2
            self.left_out["head"] = f"a wider head than of {choice.head_width}: the loss of 'small head'"
        with self._steps("refinement", choice.refine_steps) as steps:
            tuned = refine(stored, lessons, steps, head_rate, code_rate, grid)
        del lessons  # they hold on to rows of a grid, for two of which there may be no room
        played, grid = grid.features, layout.grid(tuned.density, tuned.features)
        after = self._held_out.measure("refined", grid, runner(tuned.head), 0)
        if self._gained("refinement", before, after):
            stored = tuned
        else:
            stored.features[:] = played
            del grid
            grid = layout.grid(stored.density, stored.features)
        before = self._choose_lookups_and_bits(stored, grid, taught)
        if self.n_fetches:
            lessons = collect_lessons(taught, grid, self.n_fetches)
            rates = head_rate * AT_K[choice.head_width > 0], code_rate / 2  # what is left to learn is little
            with self._steps("refinement at k", choice.refine_steps) as steps:
                tuned = refine(stored, lessons, steps, *rates, ranges=self.ranges)
            played, grid = grid.features, replace(grid, features=encode_features(tuned.features))
            head = runner(tuned.head, self.ranges)
            after = self._held_out.measure("refined at k", grid, head, self.n_fetches)
            if self._gained("refinement at k", before, after):
                return tuned
            stored.features[:] = played
        return stored

    @contextmanager
    def _steps(self, name: str, asked: int) -> Iterator[Steps]:
        """Of the next round, which takes its share of the time that is left."""
        seconds = (self._until - time.monotonic()) / self._rounds_left
        self._rounds_left -= 1
        yield (steps := Steps(asked, self._progress(name), seconds))
        if steps.n < asked:
            self.left_out[f"steps of {name!r}"] = (
                f"{asked - steps.n:,} of {asked:,}: they would take too long"
            )

    def _gained(self, name: str, before: Stage, after: Stage) -> bool:
        """Whether less is lost than before, on views that nothing has learned from."""
        if after.loss_db < before.loss_db:
            return True
        self.left_out[name] = "all of it: it lost more on views that it has not seen"
        return False

    def _new_head(self, own: HeadWeights, code_scale: np.ndarray) -> HeadWeights:
        """A small head that has not learned yet; without directions where the colours do not need them."""
        choice, n_bands = self._choice, min(self._choice.head_bands, own.sh_degree)
        lost = self._held_out.direction_loss()
        if lost < DIRECTION_SHARE * choice.target_loss_db:
            n_bands = 1
            self.left_out["directions"] = f"all of them: colours do not depend on them but for {lost:.3f} dB"
        elif n_bands < own.sh_degree:
            self.left_out["directions"] = f"{own.sh_degree - n_bands} of {own.sh_degree} bands of harmonics"
        return small_head(own, choice.head_width, choice.head_layers, n_bands, code_scale)

    def _choose_lookups_and_bits(self, stored: Stored, grid: SparseGrid, taught: Taught) -> Stage:
        """The lookups; and `ranges`, unless a head in 8 bits would lose more than the preset may even after
        it was tuned. Returns how it looks then."""
        before = self._choose_lookups(grid, stored.head)
        if self._choice.head_bits == 32:
            return before
        lessons = collect_lessons(taught.some(N_CALIBRATION), grid, self.n_fetches)
        ranges = activation_ranges(stored.head, lessons.composed(stored.features), lessons.dirs)
        after = self._held_out.measure("head in 8 bits", grid, runner(stored.head, ranges), self.n_fetches)
        lost = after.loss_db - before.loss_db
        if lost * ROUNDING_LEFT > self._choice.target_loss_db:
            self.left_out["head bits"] = f"none: with 8 bits the head would lose {lost:.3f} dB"
            return before
        self.ranges = ranges
        self.left_out["head bits"] = f"24 of 32 bits of its wide layers, {lost:.3f} dB before refinement"
        return after

    def _choose_lookups(self, grid: SparseGrid, head: HeadWeights) -> Stage:
        """Set `n_fetches` to what was asked for, or the fewest that lose no more than the preset allows; what
        each number loses is kept in `lookups`. Returns how it looks with them."""
        most = self._choice.n_fetches
        if self._config.k == "auto":
            every = self._held_out.look("all", grid, runner(head), 0).loss_db
            for k in (*(k for k in LOOKUPS if k < most), most):
                self.n_fetches = k
                self.lookups[str(k)] = self._held_out.look(str(k), grid, runner(head), k).loss_db - every
                if self.lookups[str(k)] <= self._choice.sample_loss_db:
                    break
        if not self.n_fetches:
            return self._held_out.look("all", grid, runner(head), 0)
        self.left_out["lookups"] = f"all but {self.n_fetches} of a ray; the loss that 'k' adds"
        return self._held_out.measure("k", grid, runner(head), self.n_fetches)


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
    follow them. With `ranges` the head learns to live with 8 bits (`vfr_bake.baking.head`).
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
