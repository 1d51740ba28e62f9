"""Head, stored features and densities tuned to the model, and what they are tuned for: how many lookups a
ray, and a head in 8 bits or not."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from exporters.head.onnx_head import HeadWeights, Range
from exporters.head.ranges import activation_ranges
from player.asset.grid import SparseGrid
from vfr_bake.baking.folded_head import runner
from vfr_bake.baking.grids import Layout
from vfr_bake.baking.head_weights import small_head
from vfr_bake.baking.lessons import Taught, collect_lessons
from vfr_bake.baking.loss import HeldOut, Stage
from vfr_bake.baking.pace import LOOKUPS
from vfr_bake.baking.presets import BakeChoice
from vfr_bake.baking.projection import encode_features
from vfr_bake.baking.refinement import CODE_RATE, HEAD_RATE, Progress, Steps, Stored, learn_head, refine
from vfr_bake.config import BakeConfig
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
