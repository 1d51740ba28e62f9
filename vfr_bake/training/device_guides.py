"""The guides of `vfr_bake.training.guides` for a GPU: the same decisions, on tensors of the field's
device."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from player.march.march import OPAQUE_DEPTH
from vfr_bake.config import DeviceSettings, TrainConfig
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.compositing import RaySamples
from vfr_bake.rendering.occupancy import DeviceOccupancyGrid, OccupancyGrid
from vfr_bake.rendering.proposals import N_PROPOSED, ProposalGrid, ProposalSampler
from vfr_bake.rendering.sampling import march_on_device
from vfr_bake.torch_kernels import fast
from vfr_bake.torch_kernels import proposals as kernels
from vfr_bake.torch_kernels.compositing import Padding, distortion, sums_before
from vfr_bake.torch_kernels.hash_grid import features_at
from vfr_bake.training.guides import BoxGuide, SpaceGuide
from vfr_bake.training.optimiser import DeviceGridAdam


class DeviceOccupancyGuide(BoxGuide):
    """Guide that marches through an object's box on a GPU, and keeps the occupancy grid up to date."""

    _grid: DeviceOccupancyGrid

    def __init__(
        self, config: TrainConfig, settings: DeviceSettings, step_length: float, device: torch.device
    ) -> None:
        grid = DeviceOccupancyGrid(config.occupancy_resolution, step_length, config.seed, device)
        super().__init__(settings, grid, distortion)

    @property
    def sampler(self) -> OccupancyGrid:
        return self._grid.on_cpu()

    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        grid, budget = self._grid, int(self._budget(pilot) * share)
        first = jitter[:, 0].contiguous()
        samples = march_on_device(field.lookup, grid.occupied, self._step, rays_o, rays_d, first, budget)
        grid.observe(samples.points, samples.sigmas)
        return samples


class DeviceProposalGuide(SpaceGuide):
    """Guide that trains the two proposal grids of an unbounded scene beside the field on a GPU, by
    autograd."""

    def __init__(self, settings: DeviceSettings, near: float, device: torch.device) -> None:
        super().__init__(settings, ProposalSampler(near).to(device), DeviceGridAdam, distortion)

    @property
    def sampler(self) -> ProposalSampler:
        if next(self._sampler.parameters()).device.type == "cpu":
            return self._sampler
        copy = ProposalSampler(self._sampler.near)
        copy.load_state_dict(self._sampler.state_dict())
        return copy

    def sample(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, pilot: bool, share: float
    ) -> RaySamples:
        rounds = []
        near, far = self._borders
        edges = rays_o.new_tensor([near, far]).expand(len(rays_o), 2)
        weights = rays_o.new_ones(len(rays_o), 1)
        for number, grid in enumerate(self._sampler.grids):
            exponent = self._exponent if number else 1.0
            edges = self._resample(edges, weights, exponent, jitter[:, number], N_PROPOSED)
            assert isinstance(grid, ProposalGrid)
            with torch.set_grad_enabled(self._learns):
                weights = proposal_weights(grid, rays_o, rays_d, edges)
            rounds.append((edges, weights))
        edges = self._resample(edges, weights, self._exponent, jitter[:, 2], self._n_final)
        trail = {"edges": edges, "rounds": rounds, "learns": self._learns}
        return replace(field_samples(field, rays_o, rays_d, edges), trail=trail)

    @staticmethod
    def _resample(edges: Tensor, weights: Tensor, exponent: float, jitter: Tensor, n: int) -> Tensor:
        return kernels.resample(edges.contiguous(), weights.detach(), exponent, jitter, n)

    def add_gradients(self, samples: RaySamples, weights: Tensor, n_rays: int) -> None:
        trail = samples.trail
        if not trail["learns"] or not n_rays:
            return
        final = weights.new_zeros(len(samples.counts), trail["edges"].shape[1] - 1)
        rows = Padding(samples.starts, samples.counts, len(weights)).rows(weights.detach())
        final[:, : rows.shape[1]] = rows
        losses = [kernels.interlevel(trail["edges"], final, *proposed) for proposed in trail["rounds"]]
        (torch.stack(losses).sum() / n_rays).backward()


def proposal_weights(grid: ProposalGrid, rays_o: Tensor, rays_d: Tensor, edges: Tensor) -> Tensor:
    """Return the weights [n_rays, n] that a proposal gives to intervals with the borders `edges`
    [n_rays, n + 1] in s."""
    _, lengths, points = fast(kernels.midpoints, edges.device)(rays_o, rays_d, edges)
    levels = grid.layout.levels(grid.table)
    logits = features_at(points.reshape(-1, 3), grid.table, levels).sum(dim=1)
    return kernels.weights_of(logits.reshape(lengths.shape), lengths)


@torch.no_grad()
def field_samples(field: VfrField, rays_o: Tensor, rays_d: Tensor, edges: Tensor) -> RaySamples:
    """Look the field up in the middle of the intervals with the borders `edges` [n_rays, n + 1] in s, up to
    where each ray is opaque."""
    t_mid, lengths, points = fast(kernels.midpoints, edges.device)(rays_o, rays_d, edges)
    features, sigmas = field.lookup(points.reshape(-1, 3))
    kept = sums_before(sigmas.reshape(lengths.shape) * lengths) <= OPAQUE_DEPTH
    counts, places = kept.sum(dim=1), kept.reshape(-1).nonzero()[:, 0]
    return RaySamples(
        t_mid=t_mid.reshape(-1)[places],
        deltas=lengths.reshape(-1)[places],
        points=points.reshape(-1, 3)[places],
        features=features[places],
        rays=torch.arange(len(rays_o), device=rays_o.device),
        starts=torch.cumsum(counts, dim=0) - counts,
        counts=counts,
        sigmas=sigmas[places],
    )
