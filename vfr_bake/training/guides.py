"""What finds the geometry while a field is trained: an occupancy grid for objects, proposals for
scenes.

All give the trainer the samples of rays, learn from what came of them, and are at last the sampler that the
trained field is rendered with. Those of a GPU are in `vfr_bake.training.device_guides`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from numba import get_num_threads
from torch import Tensor

from vfr_bake.config import DeviceSettings, TrainConfig
from vfr_bake.field.field import VfrField
from vfr_bake.kernels.proposals import Round, spacing
from vfr_bake.rendering.compositing import RaySamples, distortion
from vfr_bake.rendering.occupancy import TRAINING_STEPS, DeviceOccupancyGrid, OccupancyGrid
from vfr_bake.rendering.proposals import FAR, N_FINAL, ProposalSampler
from vfr_bake.rendering.render import Sampler
from vfr_bake.rendering.sampling import march
from vfr_bake.training.optimiser import GridAdam, TableAdam
from vfr_bake.training.processes import Processes

FOG_STEPS = 512
"""First steps, in which empty space has to be found: the occupancy grid is updated often, and rays through
proposals have all their samples."""
STEPS_PER_UPDATE = (16, 64)
"""Steps between two looks of the occupancy grid at the field: at first, and later."""
ANNEAL_STEPS, ANNEAL_SLOPE = 1000, 10.0
"""Proposals are believed step by step: weights ** (b x / (1 + (b - 1) x)) with x from 0 to 1 over so many
steps and b the slope (mip-NeRF 360, section C)."""
STEPS_PER_PROPOSAL_UPDATE, STEADY_STEPS = 5, 200
"""Proposals change ever more slowly, and learn in one step of so many at most (nerfacc's default): in each
one for so many steps, then in every second for as many, and so on."""


SIZES = 4
"""Sizes that a batch has until it has grown by as much as it had at first."""


class Growth(NamedTuple):
    """How batches grow on a CPU: in proportion to the number of steps, from one of them on and up to a size.

    As many rays in more steps show less, and in a capture less yet of views that are not learned from
    (docs/notes/2026-11-29-batches-that-grow.md).
    """

    after: int
    """The step from which on batches grow."""
    most: float
    """How many times its first size a batch has at last."""

    def size(self, step: int) -> float:
        """How many times its first size the batch of a step has.

        >>> [Growth(after=2000, most=4.0).size(step) for step in (0, 2400, 2500, 3000, 9000)]
        [1.0, 1.0, 1.25, 1.5, 4.0]
        """
        # Batches of one size for a while: memory that each frees suits the next one.
        return min(max(1.0, step // (self.after // SIZES) / SIZES), self.most)


GROWTH = {False: Growth(6000, 2.0), True: Growth(2000, 4.0)}
"""By whether the scene is unbounded; what limits the latter is memory, 150 kB a ray."""


class Guide(ABC):
    """The sampler in training."""

    reach: float
    """How far apart the distortion loss takes weights to be at most, in the unit of `_intervals`."""

    def __init__(self, settings: DeviceSettings, distortion: Callable[..., Tensor]) -> None:
        """`distortion`: as `vfr_bake.rendering.compositing.distortion`, for the device."""
        self._settings, self._distortion = settings, distortion
        self._size = 1.0
        """How many times its first size the next batch has."""

    @property
    @abstractmethod
    def sampler(self) -> Sampler:
        """The sampler as it is now, on the CPU."""

    @abstractmethod
    def n_rays(self, pilot: bool) -> int:
        """Rays to draw for the next batch, over all processes."""

    @abstractmethod
    def prepare(self, step: int, field: VfrField) -> None:
        """Before a step: look at what the field has become."""

    @abstractmethod
    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        """Samples of rays [n_rays, 3] with `jitter` [n_rays, 3] in [0, 1), in this process' `share` of the
        batch. What is needed later in their step is in their trail: those of the next step may be taken
        meanwhile."""

    def observe(self, n_rays: int, n_samples: int) -> None:
        """Take note of how many rays and samples the batch had, over all processes."""
        return None

    def regulariser(self, samples: RaySamples, weights: Tensor) -> Tensor | None:
        """Sum over the rays of the distortion loss of the weights [n_samples], None if its weight is 0."""
        if self._settings.distortion == 0:
            return None
        mids, widths = self._intervals(samples)
        losses = self._distortion(weights, mids, widths, self.reach, samples.starts, samples.counts)
        return self._settings.distortion * losses.sum()

    @abstractmethod
    def _intervals(self, samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Middles and widths [n_samples] of the intervals that samples stand for."""

    def add_gradients(self, samples: RaySamples, weights: Tensor, n_rays: int) -> None:
        """Add this process' gradient to the guide's own tables; losses are means over `n_rays`."""
        return None

    def tables(self, samples: RaySamples) -> Sequence[TableAdam]:
        """The tables that learn in the step of the samples, with their gradients."""
        return ()

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """All that later steps depend on, in tensors and plain values."""

    @abstractmethod
    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` returned."""


class BoxGuide(Guide):
    """Marches an object's box: what its guides have in common on all devices."""

    reach = 0.01
    """Sides of the box: what lies behind glass is not drawn to it."""

    def __init__(
        self,
        settings: DeviceSettings,
        grid: OccupancyGrid | DeviceOccupancyGrid,
        distortion: Callable[..., Tensor],
    ) -> None:
        super().__init__(settings, distortion)
        self._grid = grid
        self._step = TRAINING_STEPS * grid.step
        self._samples_per_ray = 2 / self._step

    def n_rays(self, pilot: bool) -> int:
        wanted = 1.1 * self._budget(pilot) / self._samples_per_ray
        return int(min(self._settings.max_rays, max(64, wanted)))

    def _budget(self, pilot: bool) -> int:
        # A pilot step evaluates its network on every sample, so it gets half of them and costs about as much.
        budget = self._settings.batch_samples * self._size
        return int(budget / 2 if pilot else budget)

    def prepare(self, step: int, field: VfrField) -> None:
        if step % STEPS_PER_UPDATE[step >= FOG_STEPS] == 0:
            self._grid.update(field)

    def observe(self, n_rays: int, n_samples: int) -> None:
        per_ray = max(n_samples / max(n_rays, 1), 1.0)
        self._samples_per_ray += 0.1 * (per_ray - self._samples_per_ray)

    def _intervals(self, samples: RaySamples) -> tuple[Tensor, Tensor]:
        return samples.t_mid / 2, samples.deltas / 2

    def state(self) -> dict[str, Any]:
        return {"samples_per_ray": self._samples_per_ray, "occupancy": self._grid.state()}

    def restore(self, state: dict[str, Any]) -> None:
        self._samples_per_ray = state["samples_per_ray"]
        self._grid.restore(state["occupancy"])


class OccupancyGuide(BoxGuide):
    """Marches an object's box on a CPU and keeps its occupancy grid."""

    _grid: OccupancyGrid

    def __init__(
        self, config: TrainConfig, settings: DeviceSettings, step_length: float, processes: Processes
    ) -> None:
        grid = OccupancyGrid(config.occupancy_resolution, step_length, config.seed)
        super().__init__(settings, grid, distortion)
        self._processes = processes
        self._n_chunks = get_num_threads()

    @property
    def sampler(self) -> OccupancyGrid:
        return self._grid

    def prepare(self, step: int, field: VfrField) -> None:
        if step % STEPS_PER_UPDATE[step >= FOG_STEPS] == 0:
            # Every process has seen its own rays.
            self._processes.take_largest(torch.from_numpy(self._grid.densities))
        super().prepare(step, field)
        self._size = GROWTH[False].size(step)

    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        grid, budget = self._grid, int(self._budget(pilot) * share)
        first = jitter[:, 0].contiguous()
        samples, sigmas = march(
            field, grid.distance, self._step, rays_o, rays_d, first, budget, self._n_chunks
        )
        if grid.n_updates > 0:
            grid.observe(samples.points.numpy(), sigmas)
        return samples


class SpaceGuide(Guide):
    """When the proposals of a scene learn and how far they are believed: what its guides have in common on
    all devices.

    The trail of its samples has "edges" [n_rays, n_final + 1], the borders of their intervals in s, the
    "rounds" that led to them, and whether proposals learn from these ("learns").
    """

    reach = 1.0
    """The length of the ray, in s."""

    def __init__(
        self,
        settings: DeviceSettings,
        sampler: ProposalSampler,
        adam: Callable[[Tensor], TableAdam],
        distortion: Callable[..., Tensor],
    ) -> None:
        super().__init__(settings, distortion)
        self._sampler = sampler
        self._adams = [adam(grid.table) for grid in sampler.grids]  # type: ignore[arg-type]
        self._learns = True
        self._n_final = N_FINAL
        self._exponent = 1.0
        self._borders = (float(spacing(sampler.near)), float(spacing(FAR)))
        self._span = self._borders[1] - self._borders[0]

    def n_rays(self, pilot: bool) -> int:
        n_rays = self._settings.batch_rays * self._size
        return int(n_rays / 2 if pilot else n_rays)

    def prepare(self, step: int, field: VfrField) -> None:
        x = min(1.0, step / ANNEAL_STEPS)
        self._exponent = ANNEAL_SLOPE * x / (1 + (ANNEAL_SLOPE - 1) * x)
        self._learns = step % min(STEPS_PER_PROPOSAL_UPDATE, 1 + step // STEADY_STEPS) == 0
        # Once there is more than fog, half of the samples teach as much, as they lie where matter is.
        self._n_final = N_FINAL if step < FOG_STEPS else N_FINAL // 2

    def _intervals(self, samples: RaySamples) -> tuple[Tensor, Tensor]:
        # In s, from 0 to 1 over the ray, as mip-NeRF 360 has it.
        edges = samples.trail["edges"]
        kept = torch.arange(edges.shape[1] - 1, device=edges.device) < samples.counts[:, None]
        low, high = edges[:, :-1][kept], edges[:, 1:][kept]
        return (low + high) / (2 * self._span), (high - low) / self._span

    def tables(self, samples: RaySamples) -> Sequence[TableAdam]:
        return self._adams if samples.trail["learns"] else ()

    def state(self) -> dict[str, Any]:
        return {"proposals": self._sampler.state_dict(), "adams": [adam.state() for adam in self._adams]}

    def restore(self, state: dict[str, Any]) -> None:
        self._sampler.load_state_dict(state["proposals"])
        for adam, kept in zip(self._adams, state["adams"], strict=True):
            adam.restore(kept)


class ProposalGuide(SpaceGuide):
    """Trains the two proposal grids of an unbounded scene beside the field, on a CPU."""

    def __init__(self, settings: DeviceSettings, near: float) -> None:
        super().__init__(settings, ProposalSampler(near), GridAdam, distortion)

    @property
    def sampler(self) -> ProposalSampler:
        return self._sampler

    def prepare(self, step: int, field: VfrField) -> None:
        super().prepare(step, field)
        self._size = GROWTH[True].size(step)

    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        samples, edges, rounds = self._sampler.sample_rounds(
            field, rays_o, rays_d, jitter, self._exponent, self._n_final
        )
        found = [tuple(torch.from_numpy(array) for array in each) for each in rounds]
        trail = {"edges": torch.from_numpy(edges), "rounds": found, "learns": self._learns}
        return replace(samples, trail=trail)

    def add_gradients(self, samples: RaySamples, weights: Tensor, n_rays: int) -> None:
        trail = samples.trail
        if trail["learns"]:
            rounds = [Round(*(tensor.numpy() for tensor in found)) for found in trail["rounds"]]
            self._sampler.add_gradients(rounds, trail["edges"].numpy(), samples, weights, n_rays)
