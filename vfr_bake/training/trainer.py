"""The training loop: pilot steps with standard volume rendering, then volume feature rendering (sections 3
and 4)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from player.errors import TrainingError
from vfr_bake.config import TrainConfig
from vfr_bake.data.scene import Scene
from vfr_bake.field.field import VfrField
from vfr_bake.field.pilot import Pilot
from vfr_bake.rendering.compositing import composite
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.rendering.sampling import Samples, march
from vfr_bake.training.optimiser import GridAdam, rate_factor
from vfr_bake.training.rays import PixelSampler, RayBatch

FOG_STEPS = 512
"""First steps, in which empty space has to be found and the occupancy grid is updated often."""
STEPS_PER_UPDATE = (16, 64)
"""Steps between two looks of the occupancy grid at the field: at first, and later."""
MOST_BAD_STEPS = 20
"""So many steps without a finite loss in a row mean that training has broken down."""


@dataclass(frozen=True)
class StepReport:
    """What one step did."""

    step: int
    progress: float
    """Share of the training that is done, in [0, 1]."""
    loss: float
    """Mean squared error over the rays of the batch; NaN where the step was skipped."""
    n_rays: int
    n_samples: int
    seconds: float
    """Since training began."""


class Trainer:
    """Trains a field on a scene; iterate over `run()` and use `field` and `occupancy` at any time."""

    def __init__(self, scene: Scene, config: TrainConfig) -> None:
        torch.manual_seed(config.seed)
        self.config = config
        self.field = VfrField(config.field)
        self.pilot = Pilot(config.field)
        self.occupancy = OccupancyGrid(config.occupancy_resolution, config.step, config.seed)
        self.n_bad_steps = 0
        self._generator = torch.Generator().manual_seed(config.seed)
        self._sampler = PixelSampler(scene.train, self._generator)
        self._random_background = scene.has_alpha
        self._grid_adam = GridAdam(self.field.grid.table)
        networks = [*self.field.network_parameters(), *self.pilot.parameters()]
        self._adam = torch.optim.Adam(
            networks, lr=config.network_rate, eps=1e-15, betas=(0.9, 0.99), fused=True
        )
        self._samples_per_ray = 2 / config.step

    def run(self) -> Iterator[StepReport]:
        """Train until the steps or the minutes are over. Raises TrainingError when the loss stays NaN."""
        begin = time.monotonic()
        bad_in_a_row = 0
        for step in range(self.config.steps):
            seconds = time.monotonic() - begin
            progress = max(step / self.config.steps, seconds / (60 * self.config.minutes))
            if progress >= 1:
                return
            if step % STEPS_PER_UPDATE[step >= FOG_STEPS] == 0:
                self.occupancy.update(self.field)
            loss, batch_rays, n_samples = self._step(step, progress)
            bad_in_a_row = 0 if np.isfinite(loss) else bad_in_a_row + 1
            if bad_in_a_row == MOST_BAD_STEPS:
                raise TrainingError(
                    f"step {step}: loss: not a finite number for {MOST_BAD_STEPS} steps: "
                    f"lower --network-rate (now {self.config.network_rate}) "
                    f"or --grid-rate (now {self.config.grid_rate})"
                )
            yield StepReport(step, progress, loss, batch_rays, n_samples, time.monotonic() - begin)

    def _step(self, step: int, progress: float) -> tuple[float, int, int]:
        config = self.config
        pilot = step < config.pilot_steps
        # A pilot step evaluates its network on every sample, so it gets half of them and costs about as much.
        budget = config.batch_samples // 2 if pilot else config.batch_samples
        n_rays = int(min(config.max_rays, max(64, 1.1 * budget / self._samples_per_ray)))
        batch = self._sampler.draw(n_rays)
        jitter = torch.rand(n_rays, generator=self._generator)
        samples = march(
            self.field,
            self.occupancy,
            batch.rays_o,
            batch.rays_d,
            jitter,
            budget,
            torch.get_num_threads(),
        )
        n_served, n_samples = len(samples.rays), len(samples.t_mid)
        per_ray = max(n_samples / max(n_served, 1), 1.0)
        self._samples_per_ray += 0.1 * (per_ray - self._samples_per_ray)
        factor = rate_factor(step, progress)
        loss = self._loss(batch, samples, pilot)
        value = float(loss.detach())
        self._adam.zero_grad(set_to_none=True)
        if loss.requires_grad and np.isfinite(value):
            loss.backward()
            for group in self._adam.param_groups:
                group["lr"] = config.network_rate * factor
            self._adam.step()
            self._grid_adam.step(config.grid_rate * factor)
        elif not np.isfinite(value):
            self.n_bad_steps += 1
        return value, n_served, n_samples

    def _loss(self, batch: RayBatch, samples: Samples, pilot: bool) -> Tensor:
        """Mean squared error of the served rays over a random (pictures with alpha) or white background."""
        rgba = batch.rgba[samples.rays]
        if self._random_background:
            background = torch.rand(len(rgba), 3, generator=self._generator)
        else:
            background = torch.ones(len(rgba), 3)
        target = rgba[:, :3] * rgba[:, 3:] + background * (1 - rgba[:, 3:])
        # Rays that meet nothing show the background; only the others need the field.
        hit = samples.counts > 0
        missed_error = ((background[~hit] - target[~hit]) ** 2).sum()
        features = self.field.grid(samples.points, samples.features)
        sigmas = self.field.density(features)
        dirs = batch.rays_d[samples.rays[hit]]
        starts, counts = samples.starts[hit], samples.counts[hit]
        if pilot:
            values = self.pilot(features, dirs, counts)
            colours, opacity = composite(sigmas, values, starts, counts, self.config.step)
        else:
            composited, opacity = composite(sigmas, features, starts, counts, self.config.step)
            colours = self.field.head(composited, dirs) * opacity[:, None]
        rgb = colours + background[hit] * (1 - opacity[:, None])
        return (((rgb - target[hit]) ** 2).sum() + missed_error) / (3 * max(len(rgba), 1))
