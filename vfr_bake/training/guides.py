"""What finds the geometry while a field is trained: an occupancy grid for objects, proposals for scenes.

Both give the trainer rays' samples, learn from what came of them, and are at last the sampler that the
trained field is rendered with.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from vfr_bake.config import DeviceSettings, TrainConfig
from vfr_bake.field.field import VfrField
from vfr_bake.kernels.proposals import spacing
from vfr_bake.rendering.compositing import RaySamples, distortion
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.rendering.proposals import FAR, N_FINAL, ProposalSampler
from vfr_bake.rendering.sampling import march
from vfr_bake.training.optimiser import GridAdam, TableAdam
from vfr_bake.training.processes import Processes

FOG_STEPS = 512
"""First steps, in which empty space has to be found and the occupancy grid is updated often."""
STEPS_PER_UPDATE = (16, 64)
"""Steps between two looks of the occupancy grid at the field: at first, and later."""
ANNEAL_STEPS, ANNEAL_SLOPE = 1000, 10.0
"""Proposals are believed step by step: weights ** (b x / (1 + (b - 1) x)) with x from 0 to 1 (mip-NeRF 360,
section C)."""
STEPS_PER_PROPOSAL_UPDATE = 5
"""Later proposals change slowly and learn in one step of so many (nerfacc's default)."""


class Guide(Protocol):
    """The sampler in training."""

    @property
    def sampler(self) -> OccupancyGrid | ProposalSampler: ...

    def n_rays(self, pilot: bool) -> int:
        """Rays to draw for the next batch, over all processes."""
        ...

    def prepare(self, step: int, field: VfrField) -> None:
        """Before a step: look at what the field has become."""
        ...

    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        """Samples of rays [n_rays, 3] with `jitter` [n_rays, 3] in [0, 1), in this process' `share` of the
        batch."""
        ...

    def observe(self, n_rays: int, n_samples: int) -> None:
        """What the batch came to, over all processes."""
        ...

    def regulariser(self, samples: RaySamples, weights: Tensor) -> Tensor | None:
        """Sum over the rays of a loss on the weights [n_samples], if there is one."""
        ...

    def add_gradients(self, samples: RaySamples, weights: Tensor, n_rays: int) -> None:
        """Add this process' gradient to the guide's own tables; losses are means over `n_rays`."""
        ...

    def tables(self) -> Iterator[TableAdam]:
        """The tables that learn in this step, with their gradients."""
        ...

    def state(self) -> dict[str, Any]: ...

    def restore(self, state: dict[str, Any]) -> None: ...


class OccupancyPace:
    """How many rays of an object fill a batch: what its guides have in common on all devices."""

    def __init__(self, pace: DeviceSettings, step_length: float) -> None:
        self._pace = pace
        self._samples_per_ray = 2 / step_length

    def n_rays(self, pilot: bool) -> int:
        wanted = 1.1 * self._budget(pilot) / self._samples_per_ray
        return int(min(self._pace.max_rays, max(64, wanted)))

    def _budget(self, pilot: bool) -> int:
        # A pilot step evaluates its network on every sample, so it gets half of them and costs about as much.
        return self._pace.batch_samples // 2 if pilot else self._pace.batch_samples

    def observe(self, n_rays: int, n_samples: int) -> None:
        per_ray = max(n_samples / max(n_rays, 1), 1.0)
        self._samples_per_ray += 0.1 * (per_ray - self._samples_per_ray)

    def regulariser(self, samples: RaySamples, weights: Tensor) -> None:
        return None

    def add_gradients(self, samples: RaySamples, weights: Tensor, n_rays: int) -> None:
        pass

    def tables(self) -> Iterator[TableAdam]:
        return iter(())


class OccupancyGuide(OccupancyPace):
    """Marches an object's box and keeps its occupancy grid."""

    def __init__(
        self, config: TrainConfig, pace: DeviceSettings, step_length: float, processes: Processes
    ) -> None:
        super().__init__(pace, step_length)
        self._processes = processes
        self.sampler = OccupancyGrid(config.occupancy_resolution, step_length, config.seed)

    def prepare(self, step: int, field: VfrField) -> None:
        if step % STEPS_PER_UPDATE[step >= FOG_STEPS] == 0:
            # Every process has seen its own rays.
            self._processes.take_largest(torch.from_numpy(self.sampler.densities))
            self.sampler.update(field)

    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        first = jitter[:, 0].contiguous()
        budget, n_chunks = int(self._budget(pilot) * share), torch.get_num_threads()
        samples, sigmas = march(
            field, self.sampler.distance, self.sampler.step, rays_o, rays_d, first, budget, n_chunks
        )
        if self.sampler.n_updates > 0:
            self.sampler.observe(samples.points.numpy(), sigmas)
        return samples

    def state(self) -> dict[str, Any]:
        return {"samples_per_ray": self._samples_per_ray, "occupancy": self.sampler.state()}

    def restore(self, state: dict[str, Any]) -> None:
        self._samples_per_ray = state["samples_per_ray"]
        self.sampler.restore(state["occupancy"])


class ProposalPace:
    """When the proposals of a scene learn and how far they are believed: what its guides have in common on
    all devices."""

    def __init__(self, config: TrainConfig, pace: DeviceSettings, sampler: ProposalSampler) -> None:
        self._config, self._pace, self._sampler = config, pace, sampler
        self._adams: Sequence[TableAdam] = ()
        self._learns = True
        self._exponent = 1.0
        self._borders = (float(spacing(sampler.near)), float(spacing(FAR)))
        self._span = self._borders[1] - self._borders[0]

    def n_rays(self, pilot: bool) -> int:
        return self._pace.batch_rays // 2 if pilot else self._pace.batch_rays

    def prepare(self, step: int, field: VfrField) -> None:
        x = min(1.0, step / ANNEAL_STEPS)
        self._exponent = ANNEAL_SLOPE * x / (1 + (ANNEAL_SLOPE - 1) * x)
        self._learns = step < ANNEAL_STEPS or step % STEPS_PER_PROPOSAL_UPDATE == 0

    def observe(self, n_rays: int, n_samples: int) -> None:
        pass

    def tables(self) -> Iterator[TableAdam]:
        return iter(self._adams if self._learns else ())


class ProposalGuide(ProposalPace):
    """Trains the two proposal grids of an unbounded scene beside the field."""

    def __init__(self, config: TrainConfig, pace: DeviceSettings, near: float) -> None:
        self.sampler = ProposalSampler(near)
        super().__init__(config, pace, self.sampler)
        self._adams = [GridAdam(grid.table) for grid in self.sampler.grids]  # type: ignore[arg-type]

    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        samples, self._edges, self._rounds = self.sampler.sample_rounds(
            field, rays_o, rays_d, jitter, self._exponent
        )
        return samples

    def regulariser(self, samples: RaySamples, weights: Tensor) -> Tensor | None:
        if self._config.distortion == 0:
            return None
        # In s, from 0 to 1 over the ray, as mip-NeRF 360 has it.
        kept = np.arange(N_FINAL) < samples.counts.numpy()[:, None]
        low, high = self._edges[:, :-1][kept], self._edges[:, 1:][kept]
        mids = torch.from_numpy((low + high) / np.float32(2 * self._span))
        widths = torch.from_numpy((high - low) / np.float32(self._span))
        losses = distortion(weights, mids, widths, samples.starts, samples.counts)
        return self._config.distortion * losses.sum()

    def add_gradients(self, samples: RaySamples, weights: Tensor, n_rays: int) -> None:
        if self._learns:
            self.sampler.add_gradients(self._rounds, self._edges, samples, weights, n_rays)

    def state(self) -> dict[str, Any]:
        return {"proposals": self.sampler.state_dict(), "adams": [adam.state() for adam in self._adams]}

    def restore(self, state: dict[str, Any]) -> None:
        self.sampler.load_state_dict(state["proposals"])
        for adam, kept in zip(self._adams, state["adams"], strict=True):
            adam.restore(kept)
