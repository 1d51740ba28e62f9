"""Guides, which find the geometry while a field is trained: with an occupancy grid for objects, with
proposals for scenes.

A guide gives the trainer the samples of rays and learns from their densities or weights. When training ends,
it has become the sampler that the field is rendered with. Guides for a GPU are in
`vfr_bake.training.device_guides`.
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
"""Number of first steps, in which empty space is still to be found. During these the occupancy grid is
updated more often, and rays through proposals have the full number of final samples."""
STEPS_PER_UPDATE = (16, 64)
"""Steps between two updates of the occupancy grid: during the first FOG_STEPS, and later."""
ANNEAL_STEPS, ANNEAL_SLOPE = 1000, 10.0
"""Annealing of the proposals, which are trusted more and more: weights ** (b x / (1 + (b - 1) x)), where x
rises from 0 to 1 over ANNEAL_STEPS and b is ANNEAL_SLOPE (mip-NeRF 360, section C)."""
STEPS_PER_PROPOSAL_UPDATE, STEADY_STEPS = 5, 200
"""Proposals change more and more slowly, so they learn in fewer and fewer steps: in each of the first
STEADY_STEPS, then in every second of the next STEADY_STEPS, and so on, down to one step in
STEPS_PER_PROPOSAL_UPDATE (nerfacc's default)."""


SIZES = 4
"""Batches grow in increments of 1 / SIZES of their first size."""


class Growth(NamedTuple):
    """Growth of the batches on a CPU: in proportion to the number of steps, from a given step on and up to a
    largest size.

    The same number of rays in more, smaller steps gives worse pictures, above all of a capture's views that
    are not learned from (docs/notes/2026-11-29-batches-that-grow.md).
    """

    after: int
    """Step from which on batches grow."""
    most: float
    """Largest size of a batch, in multiples of its first size."""

    def size(self, step: int) -> float:
        """Return the size of a step's batch, in multiples of its first size.

        >>> [Growth(after=2000, most=4.0).size(step) for step in (0, 2400, 2500, 3000, 9000)]
        [1.0, 1.0, 1.25, 1.5, 4.0]
        """
        # The size stays the same for many steps, so that each batch can reuse the memory of the one before.
        return min(max(1.0, step // (self.after // SIZES) / SIZES), self.most)


GROWTH = {False: Growth(6000, 2.0), True: Growth(2000, 4.0)}
"""Growth, by whether the scene is unbounded; batches of unbounded scenes are limited by memory, 150 kB a
ray."""


class Guide(ABC):
    """Sampler that is itself in training."""

    reach: float
    """Distance, in the unit of `_intervals`, at which the distortion loss saturates: weights that are farther
    apart count as this far apart."""

    def __init__(self, settings: DeviceSettings, distortion: Callable[..., Tensor]) -> None:
        """`distortion`: the implementation of `vfr_bake.rendering.compositing.distortion` for the device."""
        self._settings, self._distortion = settings, distortion
        self._size = 1.0
        """Size of the next batch, in multiples of its first size."""

    @property
    @abstractmethod
    def sampler(self) -> Sampler:
        """The sampler as it is now, on the CPU."""

    @abstractmethod
    def n_rays(self, pilot: bool) -> int:
        """Return the number of rays to draw for the next batch, over all processes."""

    @abstractmethod
    def prepare(self, step: int, field: VfrField) -> None:
        """Get ready for `step`: look at what the field has become, and set what depends on the step."""

    @abstractmethod
    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        """Sample rays [n_rays, 3], shifted by `jitter` [n_rays, 3] in [0, 1); `share` is this process' share
        of the batch. What their step needs later is kept in the samples' trail, because the next step may be
        sampled meanwhile."""

    def observe(self, n_rays: int, n_samples: int) -> None:
        """Note how many rays and samples the batch had, over all processes."""
        return None

    def regulariser(self, samples: RaySamples, weights: Tensor) -> Tensor | None:
        """Return the distortion loss of the weights [n_samples], summed over the rays; None if it is off."""
        if self._settings.distortion == 0:
            return None
        mids, widths = self._intervals(samples)
        losses = self._distortion(weights, mids, widths, self.reach, samples.starts, samples.counts)
        return self._settings.distortion * losses.sum()

    @abstractmethod
    def _intervals(self, samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Return the middles and the widths [n_samples] of the samples' intervals."""

    def add_gradients(self, samples: RaySamples, weights: Tensor, n_rays: int) -> None:
        """Add this process' gradient to that of the guide's own tables; losses are means over `n_rays`."""
        return None

    def tables(self, samples: RaySamples) -> Sequence[TableAdam]:
        """Return the optimisers of the tables that learn in the step of the samples."""
        return ()

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Return all that later steps depend on, as tensors and plain values."""

    @abstractmethod
    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned."""


class BoxGuide(Guide):
    """Base of the guides that march through an object's box, on any device."""

    reach = 0.01
    """In sides of the box; small, so that a surface behind glass is not drawn towards the glass."""

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
        # A pilot step evaluates its network at every sample: with half the samples it takes about as long.
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
    """Guide that marches through an object's box on a CPU, and keeps the occupancy grid up to date."""

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
            # Each process has raised densities along its own rays only.
            self._processes.take_largest(torch.from_numpy(self._grid.densities))
        super().prepare(step, field)
        self._size = GROWTH[False].size(step)

    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        grid, budget = self._grid, int(self._budget(pilot) * share)
        first = jitter[:, 0].contiguous()
        samples = march(field, grid.distance, self._step, rays_o, rays_d, first, budget, self._n_chunks)
        if grid.n_updates > 0:
            grid.observe(samples.points.numpy(), samples.sigmas.numpy())
        return samples


class SpaceGuide(Guide):
    """Base of the guides with proposals, on any device: it decides when the proposals learn, and how far they
    are trusted.

    The trail of its samples has "edges" [n_rays, n_final + 1], the borders of the samples' intervals in s;
    "rounds", the rounds of proposals that led to them; and "learns", whether the proposals learn in this
    step.
    """

    reach = 1.0
    """The whole length of a ray, so that the distortion loss never saturates."""

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
        # Once there is more than fog, samples lie where matter is, and half as many teach as much.
        self._n_final = N_FINAL if step < FOG_STEPS else N_FINAL // 2

    def _intervals(self, samples: RaySamples) -> tuple[Tensor, Tensor]:
        # In s, scaled so that the ray has length 1, as in mip-NeRF 360.
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
    """Guide that trains the two proposal grids of an unbounded scene beside the field, on a CPU."""

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
