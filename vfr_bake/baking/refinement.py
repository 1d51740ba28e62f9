"""Refinement: train head, stored features and densities together, and choose the number of feature lookups a
ray and whether the head computes in 8 bits.

Grid, projection, 8-bit codes and the choice of k samples change the composited features a little. So the
folded head is trained further, starting from its exact weights, together with the stored features. Its input
are the features that the player composites from the baked arrays; its targets are the colours of the full
model and of photographs. Codes are rounded where they are composited, and gradients pass as if they were not
(straight-through estimator).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor

from exporters.head.onnx_head import HeadWeights, Range
from exporters.head.ranges import activation_ranges
from player.asset.density import decode_constants
from player.asset.grid import SparseGrid
from player.march.march import MAX_TAU
from player.progress import Progress
from vfr_bake.baking.distillation import Keeping, TeacherRays, TrainingRays, collect_training_rays
from vfr_bake.baking.grids import Layout, Parts, move_towards, whole_codes, with_remainders
from vfr_bake.baking.head import FoldedHead, between, runner, small_head
from vfr_bake.baking.held_out import HeldOut, Stage
from vfr_bake.baking.limits import LOOKUPS
from vfr_bake.config import BakeConfig
from vfr_bake.kernels.stored_features import descend, descend_density, padded, slants, weigh
from vfr_bake.presets import BakeChoice
from vfr_bake.training.length.expectation import typical_step
from vfr_bake.training.length.stopwatch import Stopwatch
from vfr_bake.training.muon import Muon

N_CALIBRATION = 20_000
"""Rays from which the ranges of the head's activations are calibrated."""
BATCH, HEAD_BATCH = 4096, 1024
"""Rays of a step of refinement, and of a step in which the head alone is trained. Refinement rounds the codes
anew in each step, and the head adapts to that better with more rays. A head that is trained alone gains more
by twice the steps with half the rays."""
UNIT = 4.0
"""Unit of a channel of the head's input, in mean sizes of its composites. With so large a unit, the first
weights have the size that suits the learning rate."""
HEAD_RATE, NEW_HEAD_RATE = 5e-4, 6e-3
"""Initial learning rates of the model's own head, and of a small head that is not trained yet; they fall to
zero along a cosine."""
CODE_RATE, DENSITY_RATE = 0.375, 1.5
"""Adagrad's initial learning rates of feature codes up to 127 and of density codes; they fall along the same
cosine."""
DAMPING = 8.0
"""Initial value of Adagrad's squared gradients at all vertices, as a multiple of their mean over the vertices
that the first batch meets. Without it, a vertex that few rays meet would move as far as the others, and
overfit to those rays."""
PASSES = 10
"""Passes of a round of refinement over the training rays, unless they take more steps than the preset has. So
a small scene, whose vertices can be trained with few rays, takes few steps."""
WHOLE_LOSS, LEAST_SHARE = 4.0, 0.7
"""Loss before refinement, in target losses of the preset, for which a bake takes all steps of the preset; and
the least share of them that it takes. A sharper model loses more before refinement, and needs more steps to
make up for it (docs/notes/2026-11-30-steps-by-what-is-lost.md)."""
HEAD_STEPS = 2000
"""Steps in which a small head is trained alone before refinement."""
HEAD_SHARE = 3
"""Most steps of a small head for each step that refinement may take. They take a fifth of the time or less,
and refinement would have to make up for what the head has not learned."""
AT_K = 0.25
"""Factor on the head's learning rate in the last round, where little is left to be learned."""
AT_K_STEPS = 2 / 3
"""Steps of the last round, with the lookups and bits that are played, for each step of the first. They take
half of the time, because densities stay and a ray has fewer fetches, and teach nearly as much
(docs/notes/2026-11-30-a-round-with-the-lookups-that-are-played.md)."""
N_HEAD = 1_000_000
"""Rays on which a head is trained alone; their composites are computed once."""
KEEPING_SHARE = 1 / 3
"""Largest share of a round's time that it may take to find the fetches of all training rays, which are then
kept. For more, there are too few steps for it to pay."""
SHARES = {"small head": 0.2, "refinement": 0.7, "refinement at k": 1.0}
"""Share of the remaining time that each round may take."""
DIRECTION_SHARE = 0.1
"""A small head ignores the direction if that loses at most this share of the preset's target loss."""
ROUNDING_LEFT = 0.5
"""Expected share of a head's loss by 8 bits that remains after it was trained with them."""
BITS_SHARE = 0.5
"""Share of the preset's target loss that a head may lose by 8 bits after it was trained with them."""
MOST_FAR_OFF = 1e-4
"""Largest share of the pixels that may be far off because of fewer lookups. A lookup between two surfaces
makes a pixel stand out, although it hardly changes the mean error: lego's fast asset has 870 such pixels in a
million with 4 lookups a ray, and 40 with 8 lookups, which take 3% more time."""
N_WARM, N_TIMED = 10, 40
"""Steps at the beginning of a round that are not timed, because code may be compiled in them; and steps after
them that are timed."""


@dataclass(frozen=True, eq=False)
class Stored:
    """The head and values that the asset will hold, before the codes are rounded."""

    head: HeadWeights
    features: np.ndarray
    """[n_features, n_channels] int16: latent features, as `vfr_bake.kernels.stored_features` has them."""
    density: np.ndarray
    """[n_densities] float32 codes in 0..255, which need not be whole."""


def refined_steps(config: BakeConfig, choice: BakeChoice, n_rays: float, lost_db: float) -> int:
    """Return the steps of the first round of refinement with `n_rays` training rays that meet something, if
    `lost_db` are lost before it; or the number of steps that was given."""
    most = choice.refine_steps
    if config.refine_steps is not None:
        return most
    share = float(np.clip(lost_db / (WHOLE_LOSS * choice.target_loss_db), LEAST_SHARE, 1.0))
    return min(int(PASSES * n_rays / BATCH) + 1, int(np.ceil(share * most)))


def steps_at_k(refined: int) -> int:
    """Return the steps of the last round after `refined` steps of the first."""
    return int(np.ceil(AT_K_STEPS * refined))


def head_steps(choice: BakeChoice) -> int:
    """Return the steps in which a small head is trained alone before refinement."""
    return min(HEAD_STEPS, HEAD_SHARE * choice.refine_steps) if choice.head_width else 0


class Tuning:
    """The state that the rounds of refinement share, and their findings."""

    kept: Stage
    """The measured loss of the asset as `run` returns it. A round that gained nothing is measured, but does
    not change `kept`."""
    _in_float32: Stage
    """The measured loss of the asset with the head in float32, before the last round."""

    def __init__(
        self,
        config: BakeConfig,
        choice: BakeChoice,
        held_out: HeldOut,
        report: Callable[[str, int, int], object],
        seconds: float,
        most_kept: int = 0,
    ) -> None:
        """`seconds` is the time that all rounds together may take, if the number of steps was not given, and
        `most_kept` the bytes that the fetches of all training rays may take."""
        self.n_fetches = choice.n_fetches
        """Feature lookups of a ray, 0 for every sample."""
        self.ranges: tuple[Range, ...] | None = None
        """Ranges of the head's activations if it multiplies in 8 bits, else None."""
        self.lookups: dict[str, float] = {}
        """Loss in dB of each number of lookups that was tried, compared with a lookup at every sample."""
        self.left_out: dict[str, str] = {}
        """Descriptions, by topic, of what was left out and what that changed."""
        self._config, self._choice = config, choice
        self._held_out, self._report, self._most_kept = held_out, report, most_kept
        self._until = time.monotonic() + (seconds if config.refine_steps is None else float("inf"))

    def run(self, stored: Stored, layout: Layout, teacher: TeacherRays, again: Callable[[], Parts]) -> Stored:
        """Refine head and stored values together: with lookups at every sample first, then with the k lookups
        that are played.

        Changes the features of `stored` in place. `again` computes the original features, which are needed if
        the refined ones lose more.
        """
        choice = self._choice
        grid = layout.grid(stored.density, stored.features)
        if choice.refine_steps == 0:
            self.kept = self._choose_lookups_and_bits(stored, grid, teacher)
            return self._in_enough_bits(stored, stored)
        head_rate, code_rate = HEAD_RATE, CODE_RATE * choice.code_levels / 127
        before = self._held_out.stages[-1]
        densities = grid.rows if layout.densities is layout.features else layout.densities.rows()
        most = refined_steps(self._config, choice, len(teacher.opacity), np.inf)
        keeping = self._keeping("refinement", most, teacher)
        rays = collect_training_rays(teacher, grid, 0, densities, keeping)
        if choice.head_width:
            stored = replace(stored, head=self._new_head(stored.head, rays.typical(stored.features)))
            with self._steps("small head", head_steps(choice)) as steps:
                stored = replace(stored, head=train_head(stored, rays.some(N_HEAD), steps, NEW_HEAD_RATE))
            before = self._held_out.measure("small head", grid, runner(stored.head), 0)
            head_rate = NEW_HEAD_RATE / 2
            self.left_out["head"] = f"a wider head than of {choice.head_width}: the loss of 'small head'"
        asked = refined_steps(self._config, choice, len(rays), before.loss.db)
        with self._steps("refinement", asked) as steps:
            tuned = refine(stored, rays, steps, layout.density_range, head_rate, code_rate)
        del rays, densities  # frees the rows of the old grid: there may be no memory for two
        grid = layout.grid(tuned.density, tuned.features)
        after = self._held_out.measure("refined", grid, runner(tuned.head), 0)
        if self._gained("refinement", before, after):
            stored = tuned
        else:
            del grid
            move_towards(stored.features, again(), 0.5)
            head, density = between(stored.head, tuned.head), (stored.density + tuned.density) / 2
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
        self.kept = self._choose_lookups_and_bits(stored, grid, teacher)
        return self._refined_at_k(stored, grid, teacher, steps_at_k(asked), AT_K * head_rate, code_rate)

    def _in_enough_bits(self, stored: Stored, tuned: Stored) -> Stored:
        """Return `tuned`; or `stored`, with its head in float32, if 8 bits lose too much even after
        training."""
        lost = self._held_out.lost(self._in_float32.shown, self.kept.shown)
        if self.ranges is None or not self._is_too_much(lost.most):
            return tuned
        self.ranges, self.kept = None, self._in_float32
        self.left_out["head bits"] = f"none: with 8 bits the head would lose {lost}"
        return stored

    def _is_too_much(self, lost_db: float) -> bool:
        """Return whether 8 bits lose too much. A bake that has to reach a frame time keeps them, because its
        head and lookups are those whose frames are fast enough in 8 bits."""
        return self._config.target_ms is None and lost_db > BITS_SHARE * self._choice.target_loss_db

    def _refined_at_k(
        self,
        stored: Stored,
        grid: SparseGrid,
        teacher: TeacherRays,
        asked: int,
        head_rate: float,
        code_rate: float,
    ) -> Stored:
        """Refine head and features with the lookups and bits that are played, in at most `asked` steps, and
        keep the result if it gains anything. Changes the features of `stored` in place."""
        keeping = self._keeping("refinement at k", asked, teacher)
        rays = collect_training_rays(teacher, grid, self.n_fetches, keeping=keeping)
        left = stored.features.astype(np.int8)  # the low bytes, which `whole_codes` rounds away
        with self._steps("refinement at k", asked) as steps:
            tuned = refine(stored, rays, steps, None, head_rate, code_rate, self.ranges)
        played, grid = grid.features, replace(grid, features=whole_codes(tuned.features))
        head = runner(tuned.head, self.ranges)
        after = self._held_out.measure("refined at k", grid, head, self.n_fetches)
        if self._gained("refinement at k", self.kept, after):
            self.kept = after
        else:
            tuned = stored
        chosen = self._in_enough_bits(stored, tuned)
        if chosen is stored:
            move_towards(stored.features, with_remainders(played, left), 1.0)
        return chosen

    @contextmanager
    def _steps(self, name: str, asked: int) -> Iterator[Steps]:
        """Give the steps of round `name`, up to `asked`, within its share of the remaining time. Afterwards,
        note the steps that were left out."""
        yield (steps := Steps(asked, partial(self._report, name), self._seconds(name)))
        self._until += steps.paused
        if steps.n < asked:
            self.left_out[f"steps of {name!r}"] = (
                f"{asked - steps.n:,} of {asked:,}: they would take too long"
            )

    def _seconds(self, name: str) -> float:
        """Return the seconds that round `name` may take."""
        return SHARES[name] * (self._until - time.monotonic())

    def _keeping(self, name: str, n_steps: int, teacher: TeacherRays) -> Keeping | None:
        """Return the limits within which round `name`, of at most `n_steps` steps, keeps the fetches of the
        teacher's rays; None if its steps draw fewer rays than there are."""
        if n_steps * BATCH < len(teacher.opacity):
            return None
        return Keeping(self._most_kept, KEEPING_SHARE * self._seconds(name))

    def _gained(self, name: str, before: Stage, after: Stage) -> bool:
        """Return whether less is lost than before, on pixels that nothing is trained on; if not, note that
        round `name` was left out."""
        if self._held_out.is_better(before.shown, after.shown):
            return True
        self.left_out[name] = "all of it: it lost more on what it has not seen"
        return False

    def _new_head(self, own: HeadWeights, code_scale: np.ndarray) -> HeadWeights:
        """Make a small, untrained head. It ignores directions if the colours hardly depend on them."""
        choice, n_bands = self._choice, min(self._choice.head_bands, own.sh_degree)
        lost = self._held_out.direction_loss()
        if lost.most < DIRECTION_SHARE * choice.target_loss_db:
            n_bands = 1
            self.left_out["directions"] = f"all of them: colours do not depend on them but for {lost}"
        elif n_bands < own.sh_degree:
            self.left_out["directions"] = f"{own.sh_degree - n_bands} of {own.sh_degree} bands of harmonics"
        return small_head(own, choice.head_width, choice.head_layers, n_bands, code_scale)

    def _choose_lookups_and_bits(self, stored: Stored, grid: SparseGrid, teacher: TeacherRays) -> Stage:
        """Set `n_fetches`, and also `ranges`, unless a head in 8 bits is expected to lose more than the
        preset allows even after training. Returns the measured loss with these settings."""
        before = self._in_float32 = self._choose_lookups(grid, stored.head)
        if self._choice.head_bits == 32:
            return before
        rays = collect_training_rays(teacher.some(N_CALIBRATION), grid, self.n_fetches)
        ranges = activation_ranges(stored.head, rays.composed(stored.features)[0], rays.teacher.rays_d)
        after = self._held_out.measure("head in 8 bits", grid, runner(stored.head, ranges), self.n_fetches)
        lost = self._held_out.lost(before.shown, after.shown)
        if self._is_too_much(lost.most * ROUNDING_LEFT):
            self.left_out["head bits"] = f"none: with 8 bits the head would lose {lost}"
            return before
        self.ranges = ranges
        self.left_out["head bits"] = f"24 of 32 bits of its wide layers, {lost} before refinement"
        return after

    def _choose_lookups(self, grid: SparseGrid, head: HeadWeights) -> Stage:
        """Set `n_fetches` to the number that was given, or to the fewest lookups that lose no more than the
        preset allows and let at most a share MOST_FAR_OFF of the pixels stand out. The loss of each number
        that is tried is put into `lookups`. Returns the measured loss with the chosen number."""
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
    """The steps of a round of refinement: as many as asked for, or fewer if the time of the first ones shows
    that there is no time for all.

    >>> steps = Steps(40, lambda done, of: None)
    >>> [round(steps.falling(step), 3) for step in steps][::10]
    [1.0, 0.854, 0.5, 0.146]
    """

    def __init__(self, n_steps: int, progress: Progress, seconds: float = float("inf")) -> None:
        """`seconds` is the time that the steps may take."""
        self.n = n_steps
        self.paused = 0.0
        """Seconds of the steps so far in which the machine slept, or the process was stopped."""
        self._progress, self._seconds = progress, seconds

    def __iter__(self) -> Iterator[int]:
        step, ends = 0, list[float]()
        begin = time.perf_counter()  # the monotonic clock of Windows moves on by 16 ms at once
        watch = Stopwatch(0.0, begin)
        while step < self.n:
            yield step
            step += 1
            now = time.perf_counter()
            self.paused = now - begin - watch.step_ends(now)
            if N_WARM <= step <= N_WARM + N_TIMED:
                ends.append(now)
            if step == N_WARM + N_TIMED:
                self.n = max(int(min(self.n, self._seconds / typical_step(ends))), step)
            if step % 50 == 0 or step == self.n:
                self._progress(step, self.n)

    def falling(self, step: int) -> float:
        """Return the factor on a learning rate at `step`, along a cosine from 1 to 0."""
        return float(0.5 * (1 + np.cos(np.pi * step / self.n)))


def train_head(stored: Stored, rays: TrainingRays, steps: Steps, rate: float) -> HeadWeights:
    """Train the head alone, on the squared error of the colours over random backgrounds.

    The stored values stay as they are, so the rays' composites are computed only once.
    """
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    head = FoldedHead(stored.head, UNIT * rays.typical(stored.features))
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
    """Train head, features and densities together, on the squared error of the colours over random
    backgrounds.

    Codes are rounded where they are composited, not where they are kept. The features of `stored` are changed
    in place, because there may be no memory for a copy. With a `density_range`, which is that of `Layout`,
    densities are trained, too: the `rays` must then hold every sample and the densities around it, and the
    samples' weights follow the densities. Without it, the densities stay unchanged. With `ranges`, the head
    is trained as it is played in 8 bits.
    """
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    head = FoldedHead(stored.head, UNIT * rays.typical(stored.features), ranges)
    features, density = stored.features, stored.density.copy()
    squares, density_squares = np.zeros(len(features), np.float32), np.zeros(len(density), np.float32)
    low, slope = decode_constants(density_range or (0.0, 0.0))
    n_channels, n_parts = features.shape[1], get_num_threads()
    muon = Muon(head.parameters())
    for step in steps:
        falling = steps.falling(step)
        moving = falling if step else 0.0  # in step 0, stored values only collect squared gradients
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
    """Set Adagrad's squared gradients [n] of all vertices to DAMPING times the mean of those above 0, which
    are at the vertices that the first rays have met."""
    met = squares[squares > 0]
    squares[:] = DAMPING * met.mean() if len(met) else 0


def _loss(head: FoldedHead, composed: Tensor, opacity: Tensor, rays: TeacherRays) -> Tensor:
    """Return the mean squared error of the colours of the `rays` over random backgrounds, from their
    composites `composed` [n, n_channels] and their opacity [n]."""
    dirs, colours, full_opacity = map(torch.from_numpy, (rays.rays_d, rays.colours, rays.opacity))
    background = torch.rand(len(dirs), 3)
    shown = head(composed, dirs) * opacity[:, None] + background * (1 - opacity)[:, None]
    wanted = colours + background * (1 - full_opacity)[:, None]
    return ((shown - wanted) ** 2).mean()
