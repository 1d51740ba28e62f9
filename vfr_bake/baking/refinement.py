"""Head, stored features and densities adapted to each other, and what they are tuned for: how many lookups a
ray, and a head in 8 bits or not.

Grid, projection, 8-bit codes and the choice of k samples change the composited features a little. So the
folded head is trained, from its exact weights on, to give the colours of the full model, and those of
photographs, from the features that the player composes out of the baked arrays, and the stored
features with it. Codes are rounded where they are composed, and are trained as if they were not (straight
through).
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
from player.asset.density import decode_constants
from player.asset.grid import SparseGrid
from player.march.march import MAX_TAU
from vfr_bake.baking.cells import Progress
from vfr_bake.baking.distillation import TeacherRays, TrainingRays, collect_training_rays
from vfr_bake.baking.grids import Layout, Parts, move_towards, remainders, whole_codes, with_remainders
from vfr_bake.baking.head import FoldedHead, between, runner, small_head
from vfr_bake.baking.held_out import HeldOut, Stage
from vfr_bake.baking.limits import LOOKUPS
from vfr_bake.config import BakeConfig
from vfr_bake.kernels.stored_features import descend, descend_density, padded, slants, weigh
from vfr_bake.presets import BakeChoice
from vfr_bake.training.muon import Muon

N_CALIBRATION = 20_000
"""Rays that the calibration of the head's activations takes: they decide the ranges."""
BATCH, HEAD_BATCH = 4096, 1024
"""Rays of a step, and of a step in which the head alone is trained. Codes are rounded anew in each step, to
which a head adapts better with more rays; one that is trained alone gains more by twice the steps with half
the rays."""
UNIT = 4.0
"""Mean sizes of a channel's composites that make a unit of it; so large a unit makes the first weights of the
size that the learning rate fits."""
HEAD_RATE, NEW_HEAD_RATE = 5e-4, 6e-3
"""Learning rates of a head that the full model had, and of a small head that is not trained yet; they fall to
zero along a cosine."""
CODE_RATE, DENSITY_RATE = 0.375, 1.5
"""Adagrad's learning rates of feature codes up to 127 and of density codes; they fall along the same
cosine."""
DAMPING = 8.0
"""Adagrad's squared gradients of all vertices begin at so many times the mean that the first batch leaves at
the vertices that it meets. A vertex that few rays meet would else move as far as the others, to suit those
rays alone."""
PASSES = 10
"""How often a round of refinement looks at each training ray, unless that takes more steps than the preset
has: a small scene, whose vertices few rays suffice to teach, takes few steps."""
HEAD_STEPS, LAST_STEPS = 2000, 1000
"""Steps in which a small head is trained alone before refinement, and in which a head is trained alone for
the lookups and bits with which it is played. The latter are at most as many as refinement may have."""
HEAD_SHARE = 3
"""Steps of a small head for each step that refinement may have, at most. They take a fifth of the time or
less, and what the head has not learned refinement would have to."""
AT_K = 0.25
"""Factor of the head's learning rate in the last round, where little is left to be learned."""
N_HEAD = 1_000_000
"""Rays from which a head is trained alone, whose composites are found once."""
SHARES = {"small head": 0.2, "refinement": 0.8, "head at k": 1.0, "refinement at k": 1.0}
"""Share of the time that is left which a round may take."""
HEAD_SECONDS = 20.0
"""Seconds that the head may take in the last round in any case: it learns most of what it can in them."""
FEATURES_SECONDS = 60.0
"""Seconds that have to be left for the features to be trained in the last round: fewer gain nothing."""
DIRECTION_SHARE = 0.1
"""A small head leaves the direction out where that loses no more than this share of the loss that the preset
aims at."""
ROUNDING_LEFT = 0.5
"""Share of what a head loses by 8 bits that is left after it was tuned with them, as far as that helps."""
BITS_SHARE = 0.5
"""Share of the loss that the preset aims at which a head in 8 bits may lose by them after it was tuned."""
WORTH_A_ROUND = 0.1
"""Loss in dB by fewer lookups and a head in 8 bits for which the head is trained with them."""
WORTH_FEATURES = 0.15
"""The same for which the features are trained with them, too: where rays have a hundred samples with weight,
as in the fog of a model that has hardly learned, the few that are looked up show something else."""
MOST_FAR_OFF = 1e-4
"""Share of the pixels that may be far off because of fewer lookups. A lookup that lies between two surfaces
makes a pixel stand out that costs next to nothing on average: lego's fast asset has 870 such pixels in a
million with 4 lookups a ray and 40 with 8, which take 3% more time."""
N_WARM, N_TIMED = 10, 40
"""Steps of a round that are not timed, because something may be compiled for the first time, and steps that
are."""


@dataclass(frozen=True, eq=False)
class Stored:
    """What the asset will hold, before its codes are rounded."""

    head: HeadWeights
    features: np.ndarray
    """[n_features, n_channels] int16: latent features, as `vfr_bake.kernels.stored_features` has them."""
    density: np.ndarray
    """[n_densities] float32 codes within 0..255 that need not be whole."""


def refined_steps(config: BakeConfig, choice: BakeChoice, n_rays: float) -> int:
    """The steps of refinement from `n_rays` training rays that meet something, unless they were asked for."""
    most = choice.refine_steps
    return most if config.refine_steps is not None else min(int(PASSES * n_rays / BATCH) + 1, most)


def head_steps(choice: BakeChoice) -> int:
    """The steps in which the head is trained alone, before refinement and after it."""
    return (small_head_steps(choice) if choice.head_width else 0) + min(LAST_STEPS, choice.refine_steps)


def small_head_steps(choice: BakeChoice) -> int:
    """The steps in which a small head is trained alone before refinement."""
    return min(HEAD_STEPS, HEAD_SHARE * choice.refine_steps)


class Tuning:
    """What the rounds of refinement share, and what they find out."""

    kept: Stage
    """What the asset loses as `run` leaves it: a round that gained nothing is measured, but not kept."""
    _in_float32: Stage
    """What it would lose with a head in float32."""

    def __init__(
        self,
        config: BakeConfig,
        choice: BakeChoice,
        held_out: HeldOut,
        progress: Callable[[str], Progress],
        seconds: float,
    ) -> None:
        """`seconds`: what all rounds may take, if the number of their steps was not asked for."""
        self.n_fetches = choice.n_fetches
        """Feature lookups of a ray, 0 for all."""
        self.ranges: tuple[Range, ...] | None = None
        """Ranges of the head's activations, if it multiplies in 8 bits."""
        self.lookups: dict[str, float] = {}
        """Loss in dB by the lookups that were tried, against every sample."""
        self.left_out: dict[str, str] = {}
        """What the scene does not need, and what that changed."""
        self._config, self._choice = config, choice
        self._held_out, self._progress = held_out, progress
        self._until = time.monotonic() + (seconds if config.refine_steps is None else float("inf"))

    def run(self, stored: Stored, layout: Layout, teacher: TeacherRays, again: Callable[[], Parts]) -> Stored:
        """Head and stored values adapted to each other: at every sample, then at the k lookups that are
        played. Changes the features of `stored` in place; `again` finds what they were, should that lose."""
        choice = self._choice
        grid = layout.grid(stored.density, stored.features)
        if choice.refine_steps == 0:
            self.kept = self._choose_lookups_and_bits(stored, grid, teacher)
            return stored
        head_rate, code_rate = HEAD_RATE, CODE_RATE * choice.code_levels / 127
        before = self._held_out.stages[-1]
        densities = grid.rows if layout.densities is layout.features else layout.densities.rows()
        rays = collect_training_rays(teacher, grid, 0, densities)
        if choice.head_width:
            stored = replace(stored, head=self._new_head(stored.head, rays.typical(stored.features)))
            with self._steps("small head", small_head_steps(choice)) as steps:
                stored = replace(stored, head=train_head(stored, rays.some(N_HEAD), steps, NEW_HEAD_RATE))
            before = self._held_out.measure("small head", grid, runner(stored.head), 0)
            head_rate = NEW_HEAD_RATE / 2
            self.left_out["head"] = f"a wider head than of {choice.head_width}: the loss of 'small head'"
        with self._steps("refinement", refined_steps(self._config, choice, len(rays))) as steps:
            tuned = refine(stored, rays, steps, layout.density_range, head_rate, code_rate)
        del rays, densities  # they hold on to rows of a grid, for two of which there may be no room
        grid = layout.grid(tuned.density, tuned.features)
        after = self._held_out.measure("refined", grid, runner(tuned.head), 0)
        if self._gained("refinement", before, after):
            stored = tuned
        else:
            del grid
            move_towards(stored.features, again(), 0.5)
            head, density = between(stored.head, tuned.head, 0.5), (stored.density + tuned.density) / 2
            tuned = Stored(head, stored.features, density)
            grid = layout.grid(tuned.density, tuned.features)
            after = self._held_out.measure("half refined", grid, runner(tuned.head), 0)
            if self._gained("refinement", before, after):
                self.left_out["refinement"] = "half of the way: all of it lost more on what it has not seen"
                stored = tuned
            else:
                move_towards(stored.features, again(), 1.0)
                del grid
                grid = layout.grid(stored.density, stored.features)
        every = self._held_out.look("all", grid, runner(stored.head), 0)
        self.kept = self._choose_lookups_and_bits(stored, grid, teacher)
        lost = self._held_out.lost(every.shown, self.kept.shown).most
        if self.n_fetches and lost > WORTH_FEATURES and self._seconds_left() > FEATURES_SECONDS:
            return self._refined_at_k(stored, grid, teacher, AT_K * head_rate, code_rate)
        if lost > WORTH_A_ROUND:
            rays = collect_training_rays(teacher.some(N_HEAD), grid, self.n_fetches)
            with self._steps("head at k", min(LAST_STEPS, choice.refine_steps)) as steps:
                head = train_head(stored, rays, steps, AT_K * head_rate, self.ranges)
            after = self._held_out.measure("head at k", grid, runner(head, self.ranges), self.n_fetches)
            if self._gained("head at k", self.kept, after):
                self.kept = after
                return self._in_enough_bits(stored, replace(stored, head=head))
        return self._in_enough_bits(stored, stored)

    def _in_enough_bits(self, stored: Stored, tuned: Stored) -> Stored:
        """`tuned`; but `stored`, with its head in float32, where 8 bits lose too much all the same."""
        lost = self._held_out.lost(self._in_float32.shown, self.kept.shown)
        if self.ranges is None or lost.most <= BITS_SHARE * self._choice.target_loss_db:
            return tuned
        self.ranges, self.kept = None, self._in_float32
        self.left_out["head bits"] = f"none: with 8 bits the head would lose {lost}"
        return stored

    def _refined_at_k(
        self,
        stored: Stored,
        grid: SparseGrid,
        teacher: TeacherRays,
        head_rate: float,
        code_rate: float,
    ) -> Stored:
        """Head and features adapted to the lookups and bits that are played, if that gains anything. Changes
        the features of `stored` in place."""
        rays = collect_training_rays(teacher, grid, self.n_fetches)
        asked, left = refined_steps(self._config, self._choice, len(rays)), remainders(stored.features)
        with self._steps("refinement at k", asked) as steps:
            tuned = refine(stored, rays, steps, None, head_rate, code_rate, self.ranges)
        played, grid = grid.features, replace(grid, features=whole_codes(tuned.features))
        head = runner(tuned.head, self.ranges)
        after = self._held_out.measure("refined at k", grid, head, self.n_fetches)
        if self._gained("refinement at k", self.kept, after):
            self.kept = after
            return tuned
        move_towards(stored.features, with_remainders(played, left), 1.0)
        return stored

    @contextmanager
    def _steps(self, name: str, asked: int) -> Iterator[Steps]:
        """The steps of a round, which takes its share of the time that is left."""
        seconds = SHARES[name] * self._seconds_left()
        if name == "head at k":
            seconds = max(seconds, HEAD_SECONDS)
        yield (steps := Steps(asked, self._progress(name), seconds))
        if steps.n < asked:
            self.left_out[f"steps of {name!r}"] = (
                f"{asked - steps.n:,} of {asked:,}: they would take too long"
            )

    def _seconds_left(self) -> float:
        return self._until - time.monotonic()

    def _gained(self, name: str, before: Stage, after: Stage) -> bool:
        """Whether less is lost than before, on pixels that nothing is trained on."""
        if self._held_out.is_better(before.shown, after.shown):
            return True
        self.left_out[name] = "all of it: it lost more on what it has not seen"
        return False

    def _new_head(self, own: HeadWeights, code_scale: np.ndarray) -> HeadWeights:
        """A small head that is not trained yet; without directions where the colours do not need them."""
        choice, n_bands = self._choice, min(self._choice.head_bands, own.sh_degree)
        lost = self._held_out.direction_loss()
        if lost.most < DIRECTION_SHARE * choice.target_loss_db:
            n_bands = 1
            self.left_out["directions"] = f"all of them: colours do not depend on them but for {lost}"
        elif n_bands < own.sh_degree:
            self.left_out["directions"] = f"{own.sh_degree - n_bands} of {own.sh_degree} bands of harmonics"
        return small_head(own, choice.head_width, choice.head_layers, n_bands, code_scale)

    def _choose_lookups_and_bits(self, stored: Stored, grid: SparseGrid, teacher: TeacherRays) -> Stage:
        """Set `n_fetches`, and also `ranges`, unless a head in 8 bits would lose more than the preset allows
        even after it was tuned. Returns what the asset loses then."""
        before = self._in_float32 = self._choose_lookups(grid, stored.head)
        if self._choice.head_bits == 32:
            return before
        rays = collect_training_rays(teacher.some(N_CALIBRATION), grid, self.n_fetches)
        ranges = activation_ranges(stored.head, rays.composed(stored.features)[0], rays.teacher.rays_d)
        after = self._held_out.measure("head in 8 bits", grid, runner(stored.head, ranges), self.n_fetches)
        lost = self._held_out.lost(before.shown, after.shown)
        if lost.most * ROUNDING_LEFT > BITS_SHARE * self._choice.target_loss_db:
            self.left_out["head bits"] = f"none: with 8 bits the head would lose {lost}"
            return before
        self.ranges = ranges
        self.left_out["head bits"] = f"24 of 32 bits of its wide layers, {lost} before refinement"
        return after

    def _choose_lookups(self, grid: SparseGrid, head: HeadWeights) -> Stage:
        """Set `n_fetches` to what was asked for, or the fewest that lose no more than the preset allows and
        let no more pixels stand out than MOST_FAR_OFF; what each number loses is kept in `lookups`. Returns
        what the asset loses with them."""
        most = self._choice.n_fetches
        run = runner(head)
        if self._config.k == "auto":
            every = self._held_out.look("all", grid, run, 0).shown
            for k in (*(k for k in LOOKUPS if k < most), most):
                self.n_fetches = k
                shown = self._held_out.look(str(k), grid, run, k).shown
                lost = self._held_out.lost(every, shown)
                self.lookups[str(k)] = lost.db
                if lost.most <= self._choice.sample_loss_db and shown.far_off(every) <= MOST_FAR_OFF:
                    break
        if not self.n_fetches:
            return self._held_out.look("all", grid, run, 0)
        self.left_out["lookups"] = f"all but {self.n_fetches} of a ray; the loss that 'k' adds"
        return self._held_out.measure("k", grid, run, self.n_fetches)


class Steps:
    """The steps of a round of refinement: as many as are asked for, or fewer where there is no time for them,
    which the first ones tell.

    >>> steps = Steps(40, lambda done, of: None)
    >>> [round(steps.falling(step), 3) for step in steps][::10]
    [1.0, 0.854, 0.5, 0.146]
    """

    def __init__(self, n_steps: int, progress: Progress, seconds: float = float("inf")) -> None:
        """`seconds` is the time that the steps may take."""
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
                step_seconds = max(time.monotonic() - begin, 1e-9) / N_TIMED
                self.n = max(int(min(self.n, self._seconds / step_seconds)), step)
            if step % 50 == 0 or step == self.n:
                self._progress(step, self.n)

    def falling(self, step: int) -> float:
        """The factor of a learning rate at a step, along a cosine from 1 to 0."""
        return float(0.5 * (1 + np.cos(np.pi * step / self.n)))


def train_head(
    stored: Stored, rays: TrainingRays, steps: Steps, rate: float, ranges: tuple[Range, ...] | None = None
) -> HeadWeights:
    """The head after `steps` on the squared error of the colours over random backgrounds, with everything
    else as it is stored: what the rays compose is found once. With `ranges` it is trained as it is played in
    8 bits (`vfr_bake.baking.head`)."""
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    head = FoldedHead(stored.head, UNIT * rays.typical(stored.features), ranges)
    muon = Muon(head.parameters())
    composed, opacity = (torch.from_numpy(of_rays) for of_rays in rays.composed(stored.features))
    for step in steps:
        some = random.integers(0, len(rays), HEAD_BATCH)
        _loss(head, composed[some], opacity[some], rays.teacher.chosen(some)).backward()
        muon.step(rate * steps.falling(step))
    return head.weights()


def refine(
    stored: Stored,
    rays: TrainingRays,
    steps: Steps,
    density_range: tuple[float, float] | None,
    head_rate: float = HEAD_RATE,
    code_rate: float = CODE_RATE,
    ranges: tuple[Range, ...] | None = None,
) -> Stored:
    """Head, features and densities after `steps` on the squared error of the colours over random backgrounds.

    Codes are rounded where they are composed, not where they are kept. The features of `stored` are changed
    in place: there may be no room for them twice. With a `density_range`, that of `Layout`, the `rays` hold
    every sample and the densities around it, and their weights follow the densities. Without one the
    densities stay as they are. With `ranges` the head is trained as it is played in 8 bits.
    """
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    head = FoldedHead(stored.head, UNIT * rays.typical(stored.features), ranges)
    features, density = stored.features, stored.density.copy()
    squares, density_squares = np.zeros(len(features), np.float32), np.zeros(len(density), np.float32)
    low, slope = decode_constants(density_range or (0.0, 0.0))
    n_channels, n_parts = features.shape[1], get_num_threads()
    if density_range is not None:
        rays = rays.with_samples()
    muon = Muon(head.parameters())
    for step in steps:
        falling = steps.falling(step)
        moving = falling if step else 0.0  # stored values wait for the squared gradients of the first rays
        some = random.integers(0, len(rays), BATCH)
        fetches = rays.fetches(some)
        if density_range is not None:
            weigh(
                fetches.starts, *fetches.densities, density, low, slope, fetches.lengths, MAX_TAU,
                fetches.weights, fetches.opacity,
            )  # fmt: skip
        values = fetches.interpolate(features)
        composed = torch.from_numpy(fetches.composite(values, n_channels)).requires_grad_()
        opacity = torch.from_numpy(fetches.opacity).requires_grad_()
        _loss(head, composed, opacity, rays.teacher.chosen(some)).backward()
        muon.step(head_rate * falling)
        assert composed.grad is not None and opacity.grad is not None
        gradient = np.zeros((BATCH, padded(n_channels)), np.float32)
        gradient[:, :n_channels] = composed.grad.numpy()
        if density_range is not None:
            fetch_gradient = np.empty(len(fetches.weights), np.float32)
            slants(
                fetches.starts, *fetches.densities, fetches.weights, fetches.opacity, values, gradient,
                opacity.grad.numpy(), low, slope, fetches.lengths, density, fetch_gradient,
            )  # fmt: skip
            rate = np.float32(DENSITY_RATE * moving)
            descend_density(*fetches.densities, fetch_gradient, rate, n_parts, density, density_squares)
        rate = np.float32(code_rate * moving)
        descend(
            fetches.starts,
            *fetches.features,
            fetches.weights,
            gradient,
            rate,
            n_parts,
            features,
            squares,
            step,
        )
        if step == 0:
            _damp(squares)
            _damp(density_squares)
    return Stored(head.weights(), features, density)


def _damp(squares: np.ndarray) -> None:
    """Let the squared gradients [n] of all vertices begin at DAMPING times those that the first rays have
    left."""
    met = squares[squares > 0]
    squares[:] = DAMPING * met.mean() if len(met) else 0


def _loss(head: FoldedHead, composed: Tensor, opacity: Tensor, rays: TeacherRays) -> Tensor:
    """Mean squared error of the colours of the `rays` over random backgrounds, where they compose
    [n, n_channels] and have this opacity [n]."""
    dirs, colours, full_opacity = map(torch.from_numpy, (rays.rays_d, rays.colours, rays.opacity))
    background = torch.rand(len(dirs), 3)
    shown = head(composed, dirs) * opacity[:, None] + background * (1 - opacity)[:, None]
    wanted = colours + background * (1 - full_opacity)[:, None]
    return ((shown - wanted) ** 2).mean()
