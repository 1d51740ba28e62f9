"""The training loop: pilot steps with standard volume rendering, then volume feature rendering (sections 3
and 4 of the paper)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from player.cameras.camera import Camera
from player.errors import ConfigError, TrainingError
from vfr_bake.config import TrainConfig
from vfr_bake.data.scene import Scene
from vfr_bake.data.view_pixels import N_TRAINING_PIXELS, ViewPixels, choose_training_pixels
from vfr_bake.data.witnesses import Witnesses, choose_witnesses
from vfr_bake.field.field import VfrField
from vfr_bake.field.hash_grid import Backend
from vfr_bake.field.networks import Pilot
from vfr_bake.kernels.head.bfloat16 import fast_products
from vfr_bake.rendering.compositing import RaySamples, composite, composite_field
from vfr_bake.rendering.occupancy import TRAINING_STEPS
from vfr_bake.rendering.render import Sampler
from vfr_bake.torch_kernels import can_compile
from vfr_bake.torch_kernels.compositing import composite as composite_on_device
from vfr_bake.torch_kernels.compositing import owners
from vfr_bake.training.ahead import Sampled, SecondThread
from vfr_bake.training.captures.effects import CaptureEffects, Seen
from vfr_bake.training.device_guides import DeviceOccupancyGuide, DeviceProposalGuide
from vfr_bake.training.gradients import chosen_rays, scale_near_gradients
from vfr_bake.training.guides import Guide, OccupancyGuide, ProposalGuide
from vfr_bake.training.length.duration import Duration
from vfr_bake.training.length.stopwatch import Stopwatch
from vfr_bake.training.length.witness_errors import WitnessErrors
from vfr_bake.training.length.witness_loss import WitnessLoss
from vfr_bake.training.optimiser import (
    BETAS,
    DENSITY_DECAY,
    EPSILON,
    Adam,
    DeviceGridAdam,
    FusedGridAdam,
    GridAdam,
    TableAdam,
    rate_factor,
    shrink,
)
from vfr_bake.training.pixel_tensors import pixel_content, restore_witnesses
from vfr_bake.training.processes import Processes
from vfr_bake.training.rays import Batch, DevicePixelSampler, PixelSampler
from vfr_bake.training.scores.between import WitnessPsnr, witness_psnr
from vfr_bake.training.tensor_files import on_cpu

SOLID = 0.9
"""A picture's exposure is judged by rays where the field's opacity and the photograph's alpha exceed this."""
PILOT_SHARE = 0.25
"""The pilot's steps end after this share of the training, unless their number was given: the head has to
learn, too."""
FAINT = 0.01
"""Samples whose gradient is shorter than this many root mean squares are skipped. They are four in ten and
have a millionth of the sum of squares, but each would fetch as many table rows from memory as the others."""
MOST_BAD_STEPS = 20
"""Number of steps in a row without a finite loss after which training is given up."""


@dataclass(frozen=True)
class StepReport:
    """Figures of one optimiser step, over all processes."""

    step: int
    progress: float
    """Share of the training that is done, in [0, 1]."""
    loss: float
    """Mean squared error over the rays of the batch; NaN where the step was skipped."""
    n_rays: int
    n_samples: int
    seconds: float
    """Training time so far, interruptions left out."""


class Trainer:
    """Trainer of a field on a scene: iterate over `run()`; `field` and `sampler` may be used at any time.

    With several processes, each makes the same Trainer, draws the same joint batch, and takes its own share
    of that batch.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        processes: Processes | None = None,
        backend: Backend | None = None,
    ) -> None:
        """Make the field, its optimisers and its sampler.

        `backend`: None for numba on a CPU and torch on a GPU; "torch" to run the code of a GPU on a CPU.

        Raises ConfigError: the device is not available, or several processes cannot share it.
        """
        torch.manual_seed(config.seed)
        self.config = config
        self.device = choose_device(config.device)
        self.pace = config.for_device(self.device.type, scene.unbounded)
        self.processes = processes or Processes(0, 1)
        self._backend: Backend = backend or ("numba" if self.device.type == "cpu" else "torch")
        if self._backend == "torch" and self.processes.size > 1:
            advice = "pass --device cpu, or start one process"
            raise ConfigError(f"device: several processes: expected cpu, got {self.device.type}: {advice}")
        settings = config.field.resolved(scene.unbounded, self.device.type, config.effort)
        self._field = VfrField(settings).to(self.device)
        self._field.grid.backend = self._backend
        self.pilot = Pilot(self._field.config).to(self.device)
        self.n_bad_steps = 0
        self.next_step = 0
        """Number of the next step, and so the number of steps done."""
        self.seconds = 0.0
        """Training time so far, interruptions left out."""
        self.head_learns = False
        """Whether the last step taught the head, and not the pilot network."""
        self._generator = torch.Generator(self.device).manual_seed(config.seed)
        # A random background forces the field to be opaque where the pictures are (without alpha,
        # everywhere): against one fixed colour, a thin fog could give the same picture.
        self._random_background = scene.has_alpha or scene.unbounded
        self._views = scene.train
        self._masked = scene.masked
        self.background = None if scene.unbounded and not scene.has_alpha else np.array(scene.background)
        """[3] What is behind the pictures, sRGB in [0, 1]; None if nothing is seen through them."""
        # Not without alpha, where only plain background shows that space is empty; a GPU's batches are large.
        self._by_detail = scene.has_alpha and self.device.type == "cpu"
        witnesses = choose_witnesses(scene.train)
        self._keep_apart(witnesses.opaque() if scene.masked else witnesses)
        self.minutes = config.minutes_for(self.device.type, scene.unbounded)
        """Largest number of minutes that the training may take."""
        self.duration = Duration(self.pace.steps, self.minutes)
        """Length of the training; it gets shorter when the error at the witnesses is flat."""
        # Training may end early, by the error at the witnesses, but not if a number of steps was asked for,
        # and not on a GPU, which takes all of its steps in minutes.
        self._looks = self._backend == "numba" and config.steps is None and len(self.witnesses.pixels) > 0
        self._guide: Guide
        self._grid_adam: TableAdam
        if self._backend == "torch":
            self._use_torch(scene)
        else:
            self._use_numba(scene)
        self._second = SecondThread()
        self._next: Sampled | None = None
        """Rays and samples of the next step, if they have been drawn already."""
        self._parameters = [*self._field.network_parameters(), *self.pilot.parameters()]
        self._adam = Adam(self._parameters, BETAS, EPSILON)

    def _use_numba(self, scene: Scene) -> None:
        self._composite = composite
        if scene.unbounded:
            self._guide = ProposalGuide(self.pace, scene.near)
        else:
            self._guide = OccupancyGuide(self.config, self.pace, self._step_length(), self.processes)
        self._field.head.products = fast_products()
        grid = self._field.grid
        # FusedGridAdam never has the whole gradient, which several processes must add up before the step.
        self._grid_adam = GridAdam(grid.table) if self.processes.size > 1 else FusedGridAdam(grid)

    def _use_torch(self, scene: Scene) -> None:
        self._composite = composite_on_device
        if scene.unbounded:
            self._guide = DeviceProposalGuide(self.pace, scene.near, self.device)
        else:
            self._guide = DeviceOccupancyGuide(self.config, self.pace, self._step_length(), self.device)
        self._grid_adam = DeviceGridAdam(self._field.grid.table)
        if can_compile(self.device):
            density = self._field.density
            # Logits alone: the exponential after them is a custom autograd function: torch warns at compiling
            # it.
            density.logits = torch.compile(density.logits, dynamic=True)  # type: ignore[method-assign]
            self._field.head.compile(dynamic=True)
            self.pilot.compile(dynamic=True)

    def _keep_apart(self, witnesses: Witnesses) -> None:
        """From now on, draw from all pixels of the training views except the `witnesses`."""
        sampler = DevicePixelSampler if self._backend == "torch" else PixelSampler
        self.witnesses = witnesses
        """The pixels of the training views that no step learns from."""
        self._pixels = sampler(self._views, self._generator, witnesses, self._masked, self._by_detail)
        self._probe: WitnessErrors | None = None
        self.effects = CaptureEffects(len(witnesses.learned()), self.processes, self.device)
        """Corrections for exposure that changes and things that move, for the views that are learned from."""

    def training_pixels(self, n: int = N_TRAINING_PIXELS, everywhere: bool = False) -> ViewPixels:
        """Choose about `n` pixels among those that this training learns from: for a bake to learn from, or
        `everywhere`, whatever is seen there (`vfr_bake.data.view_pixels.choose_training_pixels`)."""
        learned, patches = self.witnesses.learned(), self.witnesses.patches(self._views.cameras)
        found = choose_training_pixels(self._views, patches, learned, n, everywhere)
        if self._masked:
            found = found.opaque()
        views = found.views()
        width, height = np.array([(camera.width, camera.height) for camera in self.cameras])[views].T
        rows, columns = np.divmod(found.pixels, width)
        places = np.stack([(columns + 0.5) / width, (rows + 0.5) / height], axis=1)
        pictures = torch.from_numpy(np.searchsorted(learned, views))
        still = self.effects.learned(pictures.to(self.device), torch.from_numpy(places).to(self.device))
        return found if still is None else found.chosen(still.cpu().numpy())

    def _step_length(self) -> float:
        """Return the length in model units of a march step when pictures are rendered."""
        return 2.0 * self.config.step_cells / TRAINING_STEPS / self._field.config.max_resolution

    @property
    def field(self) -> VfrField:
        """The field on the CPU: the one that is trained, or a copy of a GPU's as it is now."""
        return self._field.copied_to_cpu()

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of the training views, in the model frame."""
        return self._views.cameras

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of this training as plain values, with those that follow from the device filled in."""
        return asdict(self.config) | asdict(self.pace) | {"device": self.device.type}

    @property
    def sampler(self) -> Sampler:
        """The sampler, on the CPU: it decides where along a ray the field is looked up."""
        return self._guide.sampler

    def run(self) -> Iterator[StepReport]:
        """Train until the steps or the minutes are over. Raises TrainingError when the loss stays NaN."""
        watch = Stopwatch(self.seconds, time.monotonic())
        bad_in_a_row = 0
        for step in range(self.next_step, self.pace.steps):
            seconds = watch.at(time.monotonic())
            self._look(step, seconds)
            progress = self.processes.agree(self.duration.progress(step, seconds))
            if progress >= 1:
                return
            loss, n_rays, n_samples = self._step(step, progress)
            bad_in_a_row = bad_in_a_row + 1 if loss != loss else 0
            if bad_in_a_row == MOST_BAD_STEPS:
                raise TrainingError(
                    f"step {step}: loss: not a finite number for {MOST_BAD_STEPS} steps: "
                    f"lower --network-rate (now {self.pace.network_rate}) "
                    f"or --grid-rate (now {self.pace.grid_rate})"
                )
            self.next_step, self.seconds = step + 1, watch.step_ends(time.monotonic())
            yield StepReport(step, progress, loss, n_rays, n_samples, self.seconds)

    def _look(self, step: int, seconds: float) -> None:
        """Shorten the training if the error is flat; the first process decides for all. The error of a head
        that does not learn yet says nothing."""
        if self.processes.first and self._looks and self.head_learns and not self._is_unclear:
            self.duration.look(step, seconds, self._measured)

    def _measured(self) -> tuple[WitnessLoss, np.ndarray]:
        if self._probe is None:
            self._probe = WitnessErrors(self.witnesses, self._views.cameras, self.background)
        return self._probe.loss, self._probe.errors(self.field, self.sampler)

    def witness_psnr(self) -> WitnessPsnr | None:
        """Return the current PSNR at some of the witnesses. None for a scene too small to have witnesses, and
        while capture effects are on, because their errors would count."""
        if not len(self.witnesses.pixels) or self._is_unclear:
            return None
        loss, errors = self._measured()
        return witness_psnr(errors, loss.is_whole)

    @property
    def _is_unclear(self) -> bool:
        """True while capture effects are on: training cannot reduce errors that they leave at witnesses."""
        return self.effects.exposure_on or self.effects.moving_on

    def _step(self, step: int, progress: float) -> tuple[float, int, int]:
        """Take one optimiser step. Return (loss, number of rays, number of samples) over all processes; the
        loss is NaN if the step was skipped."""
        pilot = self._next is None and self._is_pilot(step, progress)
        self.head_learns = not pilot
        batch, samples = self._next or self._sampled(step, pilot)
        learned = self.effects.learned(batch.pictures, batch.places)
        n_learned = len(samples.rays) if learned is None else int(learned[samples.rays].sum())
        totals = self.processes.total(len(samples.rays), len(samples.t_mid), n_learned)
        n_rays, n_samples, n_learned = (int(total) for total in totals)
        self._guide.observe(n_rays, n_samples)
        with self._sampling_next(step, pilot):
            squares, weights, seen = self._error(batch, samples, learned, pilot)
            regulariser = self._guide.regulariser(samples, weights)
            value = self.processes.total(float(squares.detach().sum()))[0] / (3 * max(n_learned, 1))
            if self._skips(pilot):
                squares = squares * chosen_rays(squares.detach(), batch.chances[samples.rays])
            loss = squares.sum() / (3 * max(n_learned, 1))
            if regulariser is not None:
                loss = loss + regulariser / max(n_rays, 1)
            # A batch without a sample in any process has nothing to teach.
            self._adam.clear()
            if n_samples == 0 or not self._backward(loss, value, samples, weights, n_rays, pilot):
                return value if n_samples == 0 else float("nan"), n_rays, n_samples
            factor = rate_factor(step, progress)
            self._adam.step(self.pace.network_rate * factor)
            if self._field.config.unbounded:
                shrink(self._field.density.matrices(), DENSITY_DECAY * self.pace.network_rate * factor)
            for table in (self._grid_adam, *self._guide.tables(samples)):
                table.step(self.pace.grid_rate * factor)
            if seen is not None:
                self.effects.observe(seen, n_rays)
            return value, n_rays, n_samples

    def _is_pilot(self, step: int, progress: float) -> bool:
        """Return whether the pilot network gives the colours of this step. Where colours are composited
        instead of features, the head needs no pilot."""
        ended = step >= self.pace.pilot_steps or (self.config.pilot_steps is None and progress >= PILOT_SHARE)
        return not ended and self._field.config.compositing == "features"

    def _sampled(self, step: int, pilot: bool = False) -> Sampled:
        """Draw a batch for a step, which is one of the `pilot` or not, and sample it in the field as it is
        now."""
        self._guide.prepare(step, self._field)
        batch = self._draw(self._guide.n_rays(pilot))
        samples = self._guide.sample(
            self._field, batch.rays_o, batch.rays_d, batch.jitter, pilot, 1 / self.processes.size
        )
        return Sampled(batch, samples)

    @contextmanager
    def _sampling_next(self, step: int, pilot: bool) -> Iterator[None]:
        """While this context lasts, draw and sample the next step, on a second thread where there is one, and
        in the field as it is at the beginning. Whoever changes the field waits for that thread first. Nothing
        is sampled ahead of a step for which `_skips` is false."""
        self._next = None
        if not self._skips(pilot):
            yield
        elif self._second.is_there and self.processes.size == 1:
            with self._second.meanwhile(lambda: self._sampled(step + 1)) as result:
                yield
            self._next = result.result()
        else:  # several processes, too: they must communicate in a fixed order
            following = self._sampled(step + 1)
            yield
            self._next = following

    def _draw(self, n_rays: int) -> Batch:
        """Draw a joint batch, the same in all processes, and return this process' share of it."""
        rays = self._pixels.draw(n_rays)
        jitter = torch.rand(n_rays, 3, generator=self._generator, device=self.device)
        if self._random_background:
            background = torch.rand(n_rays, 3, generator=self._generator, device=self.device)
        else:
            background = torch.tensor(self.background, device=self.device).float().repeat(n_rays, 1)
        chances = torch.rand(n_rays, generator=self._generator, device=self.device)
        share = self.processes.share
        return Batch(*(share(rows) for rows in (*vars(rays).values(), jitter, background, chances)))

    def _error(
        self, batch: Batch, samples: RaySamples, learned: Tensor | None, pilot: bool
    ) -> tuple[Tensor, Tensor, Seen | None]:
        """Return (squared errors [n_served] of the served rays, summed over the channels; weights
        [n_samples]; what was seen, or None where effects need it no longer). `learned` [n_rays] bool says
        which rays are learned from, None all of them: the errors of the others are 0."""
        rgba, background = batch.rgba[samples.rays], batch.background[samples.rays]
        pictures = batch.pictures[samples.rays]
        target = rgba[:, :3] * rgba[:, 3:] + background * (1 - rgba[:, 3:])
        # Rays that meet nothing show the background; only the others need the field.
        hit = samples.counts > 0
        dirs = batch.rays_d[samples.rays[hit]]
        colours, opacity, weights = self._colours(
            samples, samples.starts[hit], samples.counts[hit], dirs, pilot
        )
        shown = self.effects.shown(colours, opacity, pictures[hit])
        errors = background - target
        errors[hit] = shown + background[hit] * (1 - opacity[:, None]) - target[hit]
        squares = errors.square().sum(dim=1)
        if learned is not None:
            squares = squares.where(learned[samples.rays], 0)
        seen = self._seen(batch, samples, hit, colours, opacity, errors) if self.effects.looks else None
        return squares, weights, seen

    def _seen(
        self, batch: Batch, samples: RaySamples, hit: Tensor, colours: Tensor, opacity: Tensor, errors: Tensor
    ) -> Seen:
        """Collect what the served rays showed, for `CaptureEffects`."""
        rays = samples.rays
        seen_opacity = torch.zeros(len(rays), device=self.device)
        seen_opacity[hit] = opacity.detach()
        seen_colours = torch.zeros(len(rays), 3, device=self.device)
        seen_colours[hit] = colours.detach()
        rgba, background = batch.rgba[rays], batch.background[rays]
        wanted = rgba[:, :3] * rgba[:, 3:] + background * (seen_opacity[:, None] - rgba[:, 3:])
        solid = (seen_opacity > SOLID) & (rgba[:, 3] > SOLID)
        pictures, places = batch.pictures[rays], batch.places[rays]
        return Seen(pictures, places, seen_colours, seen_opacity, wanted, solid, errors.detach())

    def _colours(
        self, samples: RaySamples, starts: Tensor, counts: Tensor, dirs: Tensor, pilot: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return (colour times opacity [n_hit, 3], opacity [n_hit], weights [n_samples]) of rays that hit."""
        features = self._field.grid(samples.points, samples.features)
        if self._field.config.unbounded and self.config.near_gradients > 0:
            features = scale_near_gradients(features, samples.t_mid, self.config.near_gradients)
        if self._skips(pilot):
            composited, opacity, weights = composite_field(
                self._field.density, features, samples.sigmas, samples.deltas, starts, counts, FAINT
            )
            return self._field.head(composited, dirs) * opacity[:, None], opacity, weights
        sigmas = self._field.density(features)
        if pilot or self._field.config.compositing == "colour":
            network = self.pilot if pilot else self._field.head
            values = network(features, dirs[owners(starts, counts, len(features))])
            return self._composite(sigmas, values, samples.deltas, starts, counts)
        composited, opacity, weights = self._composite(sigmas, features, samples.deltas, starts, counts)
        return self._field.head(composited, dirs) * opacity[:, None], opacity, weights

    def _skips(self, pilot: bool) -> bool:
        """Return whether a step uses the kernels that skip rays and samples without a gradient."""
        return self._backend == "numba" and not pilot and self._field.config.compositing == "features"

    def _backward(
        self, loss: Tensor, value: float, samples: RaySamples, weights: Tensor, n_rays: int, pilot: bool
    ) -> bool:
        """Compute the gradients of all that learns, summed over the processes. Return False, and drop those
        of the tables, if the loss or a network's gradient is not finite."""
        tables = [self._grid_adam, *self._guide.tables(samples)]
        if value == value and abs(value) != float("inf"):
            if loss.requires_grad:
                loss.backward()
            self._second.wait()
            self._guide.add_gradients(samples, weights, n_rays)
            gradients = self._gradients(pilot)
            if self.processes.size > 1:
                self.processes.add_up([*gradients, *(table.gradient for table in tables)])
            if bool(torch.isfinite(torch.nn.utils.get_total_norm(gradients))):
                return True
        self.n_bad_steps += 1
        for table in tables:
            table.clear()
        return False

    def _gradients(self, pilot: bool) -> list[Tensor]:
        """Return the gradients of the networks that learn in this step, zero if this process' rays met
        nothing. Other networks have no gradient, so that Adam leaves them alone."""
        network = self.pilot if pilot else self._field.head
        learning = [*self._field.density.parameters(), *network.parameters()]
        for parameter in learning:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        return [parameter.grad for parameter in learning if parameter.grad is not None]

    def state(self) -> dict[str, Any]:
        """Return all that later steps depend on, as CPU tensors and plain values. Without the next batch in
        several processes, which would all go on with the share of the one that writes the checkpoint."""
        following = self._next if self.processes.size == 1 else None
        state = {
            "step": self.next_step,
            "seconds": self.seconds,
            "n_bad_steps": self.n_bad_steps,
            "generator": self._generator.get_state(),
            "field": self._field.state_dict(),
            "pilot": self.pilot.state_dict(),
            "adam": self._adam.state(),
            "grid_adam": self._grid_adam.state(),
            "guide": self._guide.state(),
            "witnesses": pixel_content(self.witnesses),
            "pixels": self._pixels.position,
            "effects": self.effects.state(),
            "duration": self.duration.state(),
            "next": None if following is None else following.state(),
        }
        return state if self.device.type == "cpu" else on_cpu(state)

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned, as if there had been no interruption."""
        self.next_step, self.seconds, self.n_bad_steps = state["step"], state["seconds"], state["n_bad_steps"]
        self._generator.set_state(state["generator"])
        self._field.load_state_dict(state["field"])
        self.pilot.load_state_dict(state["pilot"])
        self._adam.restore(state["adam"])
        self._grid_adam.restore(state["grid_adam"])
        self._guide.restore(state["guide"])
        witnesses = restore_witnesses(state["witnesses"], self._views.cameras, "witnesses")
        del self._pixels  # otherwise, memory would hold the pictures twice
        self._keep_apart(witnesses)
        self._pixels.restore(state["pixels"])
        self.effects.restore(state["effects"])
        self.duration.restore(state["duration"])
        self._next = None if state["next"] is None else Sampled.restored(state["next"])


def choose_device(name: str) -> torch.device:
    """Return the device for a `TrainConfig.device`. Raises ConfigError: CUDA is asked for and not available.

    >>> choose_device("cpu")
    device(type='cpu')
    """
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise ConfigError("device: expected a GPU that torch can run CUDA on, got none: pass --device cpu")
    return torch.device("cuda" if there and name != "cpu" else "cpu")
